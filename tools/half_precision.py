"""A copy of a model file in half precision, for `make gpu-check`: the shipped files have no such copy."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

import numpy as np
import onnx
from onnx import NodeProto, TensorProto, helper, numpy_helper

from lanestream.inference.model_info import METADATA_KEY

# The network itself. The normalization of its pixels would overflow, and its outputs would be inexact.
_OPERATORS: Final = frozenset({"Conv", "Gemm", "MaxPool", "Relu"})


def write_half_precision(source: Path, target: Path) -> None:
    """Writes a copy of the fp32 model at `source` whose network computes in half precision, and says so."""
    model = onnx.load(source)
    graph = model.graph
    weights = {tensor.name: tensor for tensor in graph.initializer}
    halves: set[str] = set()
    casts: dict[str, NodeProto] = {}
    nodes: list[NodeProto] = []
    for node in graph.node:
        to_half = node.op_type in _OPERATORS
        for index, name in enumerate(node.input):
            if to_half and name in weights:
                _halve(weights[name])
            elif name and (name in halves) != to_half and (to_half or name in halves):
                cast = casts.get(name)
                if cast is None:
                    kind = TensorProto.FLOAT16 if to_half else TensorProto.FLOAT
                    cast = casts[name] = helper.make_node("Cast", [name], [f"{name}_cast"], f"{name}_cast", to=kind)
                    nodes.append(cast)
                node.input[index] = cast.output[0]
        if to_half:
            halves.update(node.output)
        nodes.append(node)
    del graph.node[:]
    graph.node.extend(nodes)
    # They name the old types.
    del graph.value_info[:]
    for entry in model.metadata_props:
        if entry.key == METADATA_KEY:
            entry.value = json.dumps({**json.loads(entry.value), "precision": "fp16"})
    onnx.checker.check_model(model)
    onnx.save(model, target)


def _halve(tensor: TensorProto) -> None:
    if tensor.data_type == TensorProto.FLOAT:
        half = numpy_helper.to_array(tensor).astype(np.float16)
        tensor.CopyFrom(numpy_helper.from_array(half, tensor.name))
