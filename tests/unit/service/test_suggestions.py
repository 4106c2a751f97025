"""What `doctor` suggests on different machines."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lanestream.gpu import Gpu
from lanestream.host import Cpu
from lanestream.suggestions import Findings, suggestions

VNNI = Cpu("server", ("avx2", "avx512f", "avx512_vnni"), affinity=8, quota=None, used=8)
AMX = replace(VNNI, flags=(*VNNI.flags, "amx_int8"))
NO_GPU = Gpu((), None, None, None, None, None, None)
H200 = Gpu(("NVIDIA H200, 143771 MiB",), "580.95", "13.0", "13.0", "13.0", "9.13.0", None)
# A machine that runs the networks with onnxruntime, as fast as it can.
FINE = Findings(VNNI, NO_GPU, ("cpu",), "auto", ("cpu", "cpu"), ("int8", "int8"), None, worker_limit=8)
ON_GPU = replace(FINE, gpu=H200, installed=("cuda", "cpu"), runs_on=("cuda", "cuda"), precisions=("fp16", "fp16"))
NOT_ON_GPU = replace(ON_GPU, runs_on=("cpu", "cpu"), skipped="CUDA can't be used: out of memory; it is available")


@pytest.mark.parametrize(
    "found",
    [
        pytest.param(FINE, id="onnxruntime with VNNI"),
        pytest.param(replace(FINE, installed=("openvino", "cpu")), id="OpenVINO without AMX"),
        pytest.param(
            replace(FINE, cpu=AMX, installed=("openvino", "cpu"), runs_on=("openvino", "openvino")),
            id="OpenVINO and AMX",
        ),
        pytest.param(ON_GPU, id="fp16 on a GPU"),
        pytest.param(replace(ON_GPU, cpu=AMX, worker_limit=1), id="one process on a GPU"),
        pytest.param(replace(NOT_ON_GPU, asked="cpu", skipped=None), id="the CPU was requested"),
        pytest.param(replace(FINE, cpu=replace(VNNI, affinity=64, used=64)), id="more processors than workers"),
        pytest.param(replace(FINE, cpu=replace(VNNI, quota=8.0)), id="a quota of all processors"),
    ],
)
def test_nothing_is_suggested_if_nothing_is_faster(found: Findings) -> None:
    assert suggestions(found) == ()


@pytest.mark.parametrize(
    ("found", "topic", "text"),
    [
        (replace(FINE, cpu=AMX), "openvino", "pip install 'lanestream[openvino]'"),
        (replace(FINE, cpu=AMX, installed=("openvino", "cpu"), asked="cpu"), "openvino_unused", "auto or openvino"),
        (
            replace(FINE, installed=("openvino", "cpu"), asked="openvino", runs_on=("openvino",)),
            "onnxruntime",
            "VNNI but no AMX",
        ),
        (replace(FINE, gpu=H200), "gpu_build", "the GPU (NVIDIA H200, 143771 MiB) is not used"),
        (replace(ON_GPU, precisions=("fp16", "int8")), "fp16", "--precision fp16"),
        (NOT_ON_GPU, "cuda_broken", "out of memory"),
        (replace(NOT_ON_GPU, gpu=NO_GPU), "cuda_broken", "no NVIDIA GPU answers"),
        (replace(NOT_ON_GPU, gpu=replace(H200, driver_cuda="12.8")), "cuda_broken", "its driver supports CUDA 12.8"),
        (replace(NOT_ON_GPU, gpu=replace(H200, cudnn=None)), "cuda_broken", "cuDNN can't be loaded"),
        (
            replace(NOT_ON_GPU, gpu=replace(H200, cuda=None, cudnn=None)),
            "cuda_broken",
            "CUDA and cuDNN can't be loaded",
        ),
        (
            replace(NOT_ON_GPU, asked="cuda", runs_on=(), precisions=(), skipped=None),
            "cuda_broken",
            "lanestream doctor --require cuda",
        ),
        (replace(FINE, cpu=replace(VNNI, quota=1.5, used=2)), "quota", "allows 1.5 of 8 processors"),
        (replace(FINE, worker_limit=2), "memory", "room for 2 worker processes, not 8"),
    ],
)
def test_what_would_be_faster_is_suggested(found: Findings, topic: str, text: str) -> None:
    (suggestion,) = suggestions(found)
    assert suggestion.topic == topic
    assert text in suggestion.text
    assert "\n" not in suggestion.text
