"""The ONNX graph: pixel normalization in front of the network, writing the file, its metadata, publishing it."""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from lanestream import __version__
from lanestream.errors import ExportError
from lanestream.inference.model_info import METADATA_KEY, ModelInfo
from lanestream_exporter.alexnet import LEAST_CONTRAST

# Means and standard deviations of ImageNet's red, green and blue, from 0 to 1, as torchvision uses them.
_IMAGENET_MEANS: Final = (0.485, 0.456, 0.406)
_IMAGENET_SIGMAS: Final = (0.229, 0.224, 0.225)


def imagenet(images: Tensor) -> Tensor:
    """Normalizes RGB images (N, H, W, 3) uint8 as torchvision does; returns (N, 3, H, W) float."""
    means, sigmas = (torch.tensor(values).view(1, 3, 1, 1) for values in (_IMAGENET_MEANS, _IMAGENET_SIGMAS))
    return (images.permute(0, 3, 1, 2).float() / 255.0 - means) / sigmas


def contrast(images: Tensor) -> Tensor:
    """Does the same as the normalization in `alexnet`, in fewer passes, which matter next to an int8 network."""
    sampled = images[:, ::4].float()
    mean = sampled.mean(dim=(1, 2, 3), keepdim=True)
    centered = sampled - mean
    # Runtimes compute a mean fast and a norm slowly.
    sigma = torch.sqrt((centered * centered).mean(dim=(1, 2, 3), keepdim=True))
    normalized: Tensor = (images.permute(0, 3, 1, 2).float() - mean) / (sigma + 255.0 * LEAST_CONTRAST)
    return normalized


# The graph must normalize pixels as in training. "contrast" normalizes each image by its own brightness and contrast;
# this project's networks are trained with it.
NORMALIZATIONS: Final[Mapping[str, Callable[[Tensor], Tensor]]] = {"contrast": contrast, "imagenet": imagenet}


def write_graph(module: nn.Module, example: NDArray[np.uint8], path: Path, names: tuple[str, str]) -> None:
    """Writes `module` to `path` for inputs (N, H, W, 3) uint8 of any N, shaped like `example`.

    `names` are the names of the graph's input and output.
    """
    # With a single example the exporter would fix the batch size at one.
    inputs = torch.from_numpy(np.repeat(example[:1], 2, axis=0))
    # The exporter warns about its own internals and a missing torchvision, which a user can't fix.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(
            module,
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
    """Writes `info` into the metadata of the file at `path` and removes all traces of the machine that made it."""
    model = onnx.load(str(path))
    # PyTorch records the stack trace of every node, with file paths.
    for part in (model.graph, *model.graph.node, *model.graph.value_info, *model.graph.input, *model.graph.output):
        del part.metadata_props[:]
    onnx.helper.set_model_props(model, {METADATA_KEY: info.model_dump_json()})
    onnx.save(model, str(path))


def exporter_versions() -> str:
    """Returns the versions of the software that wrote the file, for its metadata."""
    return f"lanestream {__version__}, torch {torch.__version__}, onnxruntime {onnxruntime.__version__}"


def publish(finished: Path, out: Path) -> None:
    """Copies a finished file to `out` atomically. Raises ExportError if `out` can't be written."""
    part = out.with_name(f".{out.name}.{os.getpid()}.part")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        try:
            part.write_bytes(finished.read_bytes())
            part.replace(out)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise ExportError(f"can't write {out}: {error.strerror}", "give a path that can be written") from error
