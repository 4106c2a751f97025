"""Lists the commands of this package for `lanestream`, which finds the list by its entry point.

It is data only, so that `lanestream --help` imports no command and works without any extra.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

COMMANDS: Final[Mapping[str, Mapping[str, str]]] = {
    "scene": {
        "target": "lanestream_exporter.scene_commands:scene",
        "extra": "video",
        "help": "Render a clip of a road with exact labels.",
    },
    "calibrate": {
        "target": "lanestream_exporter.calibration_commands:calibrate",
        "extra": "service,cpu",
        "help": "Make a camera file from pictures of a chessboard, or from a drive.",
    },
    "data": {
        "target": "lanestream_exporter.data_commands:data",
        "extra": "data",
        "help": "Check labeled frames, and find public ones.",
    },
    "label": {
        "target": "lanestream_exporter.label_commands:label",
        "extra": "data,service,cpu",
        "help": "Write the lanes in images or a video as labels to correct.",
    },
    "train": {
        "target": "lanestream_exporter.training_commands:train",
        "extra": "train,service,cpu",
        "help": "Train a network.",
    },
    "export": {
        "target": "lanestream_exporter.export_commands:export",
        "extra": "export,service,cpu",
        "help": "Convert a checkpoint to a model file.",
    },
    "evaluate": {
        "target": "lanestream_exporter.evaluation_commands:evaluate",
        "extra": "export,service,cpu",
        "help": "Measure the accuracy of models and of tracking.",
    },
    "score": {
        "target": "lanestream_exporter.score_commands:score",
        "extra": "data",
        "help": "Measure a stream's results against labels.",
    },
}
