"""SIGTERM during the start. A container's first process ignores signals without a handler, so it needs one early."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

COMMAND = """
import os, signal
from lanestream import cli
os.getpid = lambda: {number}
cli.cli.main = lambda **_: signal.raise_signal(signal.SIGTERM)
cli.main()
"""


@pytest.mark.parametrize(("number", "code"), [(1, 143), (77, -signal.SIGTERM)])
def test_sigterm_ends_a_starting_process_also_as_process_1(number: int, code: int) -> None:
    result = subprocess.run([sys.executable, "-c", COMMAND.format(number=number)], check=False)
    assert result.returncode == code
