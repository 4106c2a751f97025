"""Hard scenes: on which images the two detectors count as disagreeing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from lanestream.detection.interface import Detections, FrameContext, Infer
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR
from lanestream.errors import ModelError
from lanestream.road.appearance import Appearance
from lanestream.road.curve import Curve
from lanestream.road.results import Detection
from lanestream.road.view import Image, RoadView
from lanestream_exporter.samples.hard_scenes import Committee, Disagreement

IMAGE = np.zeros((360, 640, 3), np.uint8)
NOT_USED: Any = None


class Seeing:
    """A detector that sees straight boundaries at lateral positions, each an edge with the given probability."""

    def __init__(self, boundaries: Mapping[float, float], horizon: float = 150.0) -> None:
        self._boundaries, self._horizon = boundaries, horizon

    def detect(self, image: Image, context: FrameContext, infer: Infer) -> Detections:
        view = RoadView(image.shape[1], image.shape[0], self._horizon)
        found = [
            Detection(
                Curve(view.horizon, (view.middle, position, 0.0)),
                np.eye(3),
                view.horizon + 20.0,
                view.bottom,
                0.9,
                appearance=Appearance(edge),
            )
            for position, edge in sorted(self._boundaries.items())
        ]
        return Detections(tuple(found), view, 1.0)


def disagree(one: Seeing, other: Seeing) -> bool:
    return Disagreement(cast(Any, one), cast(Any, other), NOT_USED, NOT_USED).about(IMAGE)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ({-1.2: 0.1, 1.2: 0.9}, False),
        ({-1.1: 0.1, 1.3: 0.6}, False),
        ({-1.2: 0.1, 1.4: 0.9}, True),
        ({-1.2: 0.1, 1.2: 0.4}, True),
        ({-1.2: 0.1}, True),
        ({1.2: 0.9}, True),
        ({}, True),
        ({-3.6: 0.1, -1.2: 0.1, 1.2: 0.9, 3.6: 0.9}, False),
        ({-1.2: 0.1, 0.3: 0.1, 1.2: 0.9}, True),
    ],
)
def test_detectors_disagree_if_their_ego_lanes_have_other_boundaries(
    other: Mapping[float, float], expected: bool
) -> None:
    one = Seeing({-1.2: 0.1, 1.2: 0.9})
    assert disagree(one, Seeing(other)) == disagree(Seeing(other), one) == expected


def test_detectors_that_see_nothing_agree() -> None:
    assert not disagree(Seeing({}), Seeing({}))


def test_a_committee_is_a_classifier_and_a_regressor(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"regressor\.onnx is not a classifier"):
        Committee(SHIPPED_REGRESSOR, SHIPPED_REGRESSOR).load()
    with pytest.raises(ModelError, match=r"classifier\.onnx is not a regressor"):
        Committee(SHIPPED_MODEL, SHIPPED_MODEL).load()
    with pytest.raises(ModelError, match=r"gone\.onnx"):
        Committee(tmp_path / "gone.onnx", SHIPPED_REGRESSOR).load()


def test_other_files_have_another_digest(tmp_path: Path) -> None:
    committee = Committee(SHIPPED_MODEL, SHIPPED_REGRESSOR)
    assert committee.digest == Committee(SHIPPED_MODEL, SHIPPED_REGRESSOR).digest
    changed = tmp_path / "changed.onnx"
    changed.write_bytes(SHIPPED_MODEL.read_bytes() + b"\0")
    assert Committee(changed, SHIPPED_REGRESSOR).digest != committee.digest
