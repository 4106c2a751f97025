"""Answers do not change unless a change means to: `python tools/golden.py tests/accuracy/golden.json` writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from golden import golden_answers

GOLDEN = Path(__file__).with_name("golden.json")
# Processors differ in the last digits of a network's outputs; a changed rule differs by more.
TOLERANCE = {"points": 0.5, "horizon": 0.5, "probability": 0.02, "lane_width_m": 0.02, "offset_m": 0.02}


def _close(answer: Any, expected: Any, name: str = "") -> Any:
    """Returns `answer` with every number that is close to the expected one replaced by that."""
    if isinstance(answer, dict) and isinstance(expected, dict):
        return {key: _close(value, expected.get(key), key) for key, value in answer.items()}
    if isinstance(answer, list) and isinstance(expected, list) and len(answer) == len(expected):
        return [_close(one, other, name) for one, other in zip(answer, expected, strict=True)]
    if isinstance(answer, float) and isinstance(expected, int | float):
        return expected if answer == pytest.approx(expected, rel=0.0, abs=TOLERANCE.get(name, 0.005)) else answer
    return answer


def test_answers_are_those_of_the_golden_file() -> None:
    expected = json.loads(GOLDEN.read_text(encoding="utf-8"))
    answers = golden_answers()
    for name, messages in expected.items():
        for seq, (message, golden) in enumerate(zip(answers[name], messages, strict=True)):
            assert _close(message, golden) == golden, f"{name}, frame {seq}"
    assert answers.keys() == expected.keys()
