"""From PyTorch to ONNX files."""

from __future__ import annotations

import logging
import os
import warnings
from pathlib import Path

import numpy as np
import onnx
import torch
from numpy.typing import NDArray
from torch import nn

from lanestream.errors import ExportError
from lanestream.inference import ModelInfo
from lanestream.inference.model_info import METADATA_KEY


def write_graph(served: nn.Module, example: NDArray[np.uint8], path: Path, names: tuple[str, str]) -> None:
    """Writes `served` to `path`: uint8 inputs (N, H, W, 3) like `example`'s, for any N; `names` of input and output."""
    # Of one input the exporter would make a graph for one alone.
    inputs = torch.from_numpy(np.repeat(example[:1], 2, axis=0))
    # The exporter warns of its own innards and of torchvision's absence: nothing that a user could mend.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            served,
            (inputs,),
            input_names=[names[0]],
            output_names=[names[1]],
            dynamic_shapes=({0: torch.export.Dim("batch", min=1, max=1024)},),
            dynamo=True,
            verbose=False,
        )
    assert program is not None  # noqa: S101 - dynamo=True always returns a program
    program.save(str(path), external_data=False)


def describe(path: Path, info: ModelInfo) -> None:
    """Makes the file at `path` say of itself what `info` says, and nothing of the machine that it was made on."""
    model = onnx.load(str(path))
    # PyTorch notes the stack of every node, with the paths of the files in it.
    for part in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        del part.metadata_props[:]
    onnx.helper.set_model_props(model, {METADATA_KEY: info.model_dump_json()})
    onnx.save(model, str(path))


def publish(unfinished: Path, out: Path) -> None:
    """Puts a finished file to `out`, whole or not at all. Raises ExportError where nothing can be written there."""
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(unfinished.read_bytes())
            part.replace(out)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise ExportError(f"can't write {out}: {error.strerror}", "give a path that can be written") from error
