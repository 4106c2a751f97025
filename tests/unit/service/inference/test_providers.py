"""Which provider runs a network, how that is reported, and that all providers compute the same outputs."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
from numpy.typing import NDArray

from lanestream.detection.interface import ModelRole
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, load_engine
from lanestream.errors import ModelError, ProviderError
from lanestream.inference import onnx_model, openvino_model, providers
from lanestream.inference.loaded_model import LoadedModel, Placement
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import ModelInfo
from lanestream.inference.onnx_model import CPU_BATCH_SIZES, GPU_BATCH_SIZES, BoundOnnxModel, OnnxModel
from lanestream.inference.providers import (
    CPU,
    CUDA,
    DEFAULT_OPTIONS,
    PROVIDERS,
    Installed,
    ProviderSpec,
    RuntimeOptions,
    attempts,
    find_provider,
    tensorrt_options,
)
from lanestream.session import Session
from lanestream_exporter.scenes import render_still, sample_scene

CPU_ALONE = Installed(frozenset({"CPUExecutionProvider"}), openvino=False, amx=True)
WITH_CUDA = Installed(frozenset({"CUDAExecutionProvider", "CPUExecutionProvider"}), openvino=False, amx=True)
WITH_OPENVINO = Installed(frozenset({"CPUExecutionProvider"}), openvino=True, amx=True)
FP32_MODEL = SHIPPED_MODEL.with_name("classifier-fp32.onnx")


class CountingModel(LoadedModel):
    """Returns the first pixel of each input as its first output, and records its batches."""

    def __init__(self, info: ModelInfo, batch_sizes: tuple[int, ...]) -> None:
        super().__init__(info, Placement("cpu", "a test", 1, {}, batch_sizes))
        self.batches: list[NDArray[np.uint8]] = []

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.batches.append(inputs)
        outputs = np.zeros((len(inputs), self.info.outputs), np.float32)
        outputs[:, 0] = inputs[:, 0, 0, 0]
        return outputs


@pytest.fixture(scope="module")
def classifier() -> OnnxModel:
    return onnx_model.load(SHIPPED_MODEL)


@pytest.fixture(scope="module")
def inputs() -> dict[ModelRole, NDArray[np.uint8]]:
    """What the shipped detectors send to the classifier and to the regressor for rendered roads."""
    engine = load_engine(provider="cpu")
    sent: dict[ModelRole, list[NDArray[np.uint8]]] = {"classifier": [], "regressor": []}

    def infer(role: ModelRole, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        sent[role].append(inputs)
        return engine.models[role].run(inputs)

    rng = np.random.default_rng(11)
    for _ in range(8):
        image = render_still(sample_scene(rng, 640, 360)).image
        Session(engine.detectors["candidates"]).process(image, 0.0, infer)
    return {role: np.concatenate(parts) for role, parts in sent.items()}


def numbered(count: int, size: int) -> NDArray[np.uint8]:
    inputs = np.zeros((count, size, size, 3), np.uint8)
    inputs[:, 0, 0, 0] = np.arange(1, count + 1)
    return inputs


@pytest.mark.parametrize(
    ("count", "batches"), [(0, []), (1, [1]), (3, [4]), (4, [4]), (9, [8, 1]), (11, [8, 4]), (16, [8, 8])]
)
def test_batches_are_padded_and_their_outputs_are_in_order(
    classifier: OnnxModel, count: int, batches: list[int]
) -> None:
    model = CountingModel(classifier.info, (1, 2, 4, 8))
    outputs = model.run(numbered(count, classifier.info.input_size))
    assert outputs[:, 0].tolist() == list(range(1, count + 1))
    assert outputs.shape == (count, classifier.info.outputs)
    assert [len(batch) for batch in model.batches] == batches


def test_a_batch_that_fits_is_not_copied(classifier: OnnxModel) -> None:
    model = CountingModel(classifier.info, CPU_BATCH_SIZES)
    inputs = numbered(16, classifier.info.input_size)
    for count in CPU_BATCH_SIZES:
        model.run(inputs[:count])
    assert all(np.shares_memory(batch, inputs) for batch in model.batches)


def test_warming_up_runs_every_batch_size_the_largest_first(classifier: OnnxModel) -> None:
    model = CountingModel(classifier.info, GPU_BATCH_SIZES)
    model.warm_up()
    assert sorted(len(batch) for batch in model.batches) == list(GPU_BATCH_SIZES)
    assert len(model.batches[0]) == GPU_BATCH_SIZES[-1]


def test_auto_takes_the_cpu_if_nothing_else_is_installed_and_says_why() -> None:
    model = load_model(SHIPPED_MODEL, "auto", installed=CPU_ALONE)
    assert not model.placement.fell_back, "nothing that is installed has failed"
    assert model.sha256 == hashlib.sha256(SHIPPED_MODEL.read_bytes()).hexdigest()
    assert model.placement.provider == "cpu"
    assert model.placement.reason == (
        "the installed onnxruntime has no CUDA; OpenVINO is not installed; onnxruntime on the CPU is always available"
    )


def test_auto_never_takes_tensorrt() -> None:
    for installed in (WITH_CUDA, WITH_OPENVINO, replace(WITH_OPENVINO, amx=False)):
        assert "tensorrt" not in [spec.name for spec, _ in attempts("auto", installed)]


@pytest.mark.parametrize(("amx", "provider"), [(True, "openvino"), (False, "cpu")])
def test_auto_takes_openvino_only_on_a_cpu_with_amx(amx: bool, provider: str) -> None:
    model = load_model(SHIPPED_MODEL, "auto", installed=replace(WITH_OPENVINO, amx=amx))
    assert model.placement.provider == provider
    assert "AMX" in model.placement.reason
    assert not model.placement.fell_back, "OpenVINO works"


def test_the_machine_is_asked_what_is_installed() -> None:
    here = Installed.here()
    assert here.openvino
    assert here.amx == ("amx_int8" in Path("/proc/cpuinfo").read_text())
    assert CPU.is_installed(here)
    assert WITH_CUDA.without_gpus() == CPU_ALONE


# This build of onnxruntime has no CUDA: it falls back silently, as it also does if a library is missing.
@pytest.mark.filterwarnings("ignore:Specified provider")
def test_cuda_that_is_built_in_and_does_not_work_is_detected() -> None:
    with pytest.raises(
        ProviderError, match="CUDA does not work: onnxruntime fell back to CPUExecutionProvider"
    ) as error:
        load_model(SHIPPED_MODEL, "cuda", installed=WITH_CUDA)
    assert "lanestream doctor" in error.value.hint
    model = load_model(SHIPPED_MODEL, "auto", installed=WITH_CUDA)
    assert (model.placement.provider, model.placement.fell_back) == ("cpu", True)
    assert "CUDA does not work" in model.placement.reason


@pytest.mark.parametrize(
    ("provider", "message"),
    [("cuda", "has no CUDA"), ("tensorrt", "has no TensorRT"), ("openvino", "OpenVINO is not installed")],
)
def test_a_requested_provider_that_is_not_installed_is_an_error_of_one_line(provider: str, message: str) -> None:
    with pytest.raises(ProviderError, match=message) as error:
        load_model(SHIPPED_MODEL, provider, installed=CPU_ALONE)
    assert "\n" not in str(error.value)
    assert "install" in error.value.hint


def test_an_unknown_provider_is_an_error_that_lists_the_known_ones() -> None:
    with pytest.raises(ProviderError, match="'quantum' is not a provider") as error:
        load_model(SHIPPED_MODEL, "quantum", installed=CPU_ALONE)
    assert error.value.hint == "use auto, cuda, tensorrt, openvino, cpu"


def test_without_openvino_everything_else_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert load_model(SHIPPED_MODEL, installed=CPU_ALONE).placement.provider == "cpu"
    with pytest.raises(ProviderError, match="OpenVINO does not work"):
        openvino_model.load(SHIPPED_MODEL)


def test_a_provider_is_added_by_a_row_of_the_table(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, classifier: OnnxModel
) -> None:
    """A row and a module with a `load` function: nothing else knows the provider."""
    (tmp_path / "abacus_model.py").write_text(
        "from lanestream.inference import onnx_model\n"
        "from lanestream.inference.providers import CPU\n"
        "def load(path, spec, options, reason):\n"
        "    model = onnx_model.load(path, CPU, options, reason)\n"
        "    model.requested = spec.name, options.threads\n"
        "    return model\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    abacus = ProviderSpec(
        name="abacus",
        title="Abacus",
        is_installed=lambda installed: installed.amx,
        missing=("there is no abacus", "buy one"),
        auto_reason=lambda installed: "an abacus is always better",
        module="abacus_model",
    )
    monkeypatch.setattr(providers, "PROVIDERS", (CUDA, abacus, *PROVIDERS[1:]))
    for provider in ("abacus", "auto"):
        model = load_model(SHIPPED_MODEL, provider, RuntimeOptions(threads=1), installed=CPU_ALONE)
        assert model.requested == ("abacus", 1)  # type: ignore[attr-defined]
        np.testing.assert_array_equal(model.run(model.blank(2)), classifier.run(classifier.blank(2)))
    assert model.placement.reason == "the installed onnxruntime has no CUDA; an abacus is always better"
    assert find_provider("abacus") is abacus
    with pytest.raises(ProviderError, match="there is no abacus"):
        load_model(SHIPPED_MODEL, "abacus", installed=replace(CPU_ALONE, amx=False))


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_the_number_of_threads_can_be_set(provider: str) -> None:
    model = load_model(SHIPPED_MODEL, provider, RuntimeOptions(threads=1))
    assert model.placement.threads == 1
    assert sum(model.placement.nodes.values()) > 10


def test_a_model_with_bound_buffers_computes_what_a_plain_one_computes(
    classifier: OnnxModel, inputs: dict[ModelRole, NDArray[np.uint8]]
) -> None:
    """Runs the code for GPUs with buffers on the CPU: padding, more inputs than a batch, outputs that stay valid."""

    class OnTheCpu(BoundOnnxModel):
        device = "cpu"

    session = onnxruntime.InferenceSession(str(SHIPPED_MODEL), providers=["CPUExecutionProvider"])
    model = OnTheCpu(session, classifier.info, Placement("cpu", "a test", 1, {}, (1, 2, 4, 8)))
    patches = inputs["classifier"][:21]
    first, later = model.run(patches), model.run(patches[::-1])
    np.testing.assert_allclose(first, classifier.run(patches), atol=1e-6)
    np.testing.assert_allclose(later[::-1], first, atol=1e-6)


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_an_invalid_file_is_not_reported_as_a_fault_of_the_gpu(tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("hello")
    with pytest.raises(ModelError, match="not a model"):
        load_model(text, "cuda", installed=WITH_CUDA)


def test_tensorrt_keeps_the_precision_of_the_file(classifier: OnnxModel, tmp_path: Path) -> None:
    assert tensorrt_options(classifier.info, DEFAULT_OPTIONS) == {"trt_fp16_enable": "0"}
    half = classifier.info.model_copy(update={"precision": "fp16"})
    options = tensorrt_options(half, RuntimeOptions(engine_cache=tmp_path))
    assert (options["trt_fp16_enable"], options["trt_engine_cache_path"]) == ("1", str(tmp_path))


def test_openvino_computes_what_onnxruntime_computes(inputs: dict[ModelRole, NDArray[np.uint8]]) -> None:
    patches = inputs["classifier"]
    paths = (SHIPPED_MODEL, FP32_MODEL)
    by_onnxruntime = {path: onnx_model.load(path).run(patches) for path in paths}
    by_openvino = {path: openvino_model.load(path).run(patches) for path in paths}

    difference = np.abs(by_openvino[FP32_MODEL] - by_onnxruntime[FP32_MODEL])
    # The tolerance of an export against PyTorch: bfloat16, OpenVINO's default if the CPU has it, is ten times worse.
    assert difference.mean() <= 1e-4
    assert difference.max() <= 1e-3

    # Ties are rounded differently. That must be small compared with the error of int8 itself.
    rounding = np.abs(by_onnxruntime[SHIPPED_MODEL] - by_onnxruntime[FP32_MODEL]).mean()
    difference = np.abs(by_openvino[SHIPPED_MODEL] - by_onnxruntime[SHIPPED_MODEL])
    assert difference.mean() <= 0.1 * rounding
    assert difference.max() <= 0.1

    crops = inputs["regressor"]
    difference = np.abs(
        onnx_model.load(SHIPPED_REGRESSOR).run(crops) - openvino_model.load(SHIPPED_REGRESSOR).run(crops)
    )
    # A thirtieth of the tolerance of an int8 export against PyTorch.
    assert difference.mean() <= 1e-3
    assert difference.max() <= 0.02


RUN_WITH_OPENVINO = """
import sys
import numpy as np
from pathlib import Path
from lanestream.inference import openvino_model
inputs = np.load(sys.argv[2])
np.save(sys.argv[3], openvino_model.load(Path(sys.argv[1])).run(inputs))
"""


@pytest.mark.parametrize(
    ("path", "role"), [(SHIPPED_MODEL, "classifier"), (SHIPPED_REGRESSOR, "regressor")], ids=["classifier", "regressor"]
)
def test_int8_outputs_are_the_same_on_a_cpu_without_vnni(
    path: Path, role: ModelRole, inputs: dict[ModelRole, NDArray[np.uint8]], tmp_path: Path
) -> None:
    """Such a CPU adds products in 16 bits, in which sums of products with 8-bit weights would saturate."""
    inputs_file, outputs_file = tmp_path / "inputs.npy", tmp_path / "outputs.npy"
    np.save(inputs_file, inputs[role])
    command = [sys.executable, "-c", RUN_WITH_OPENVINO, str(path), str(inputs_file), str(outputs_file)]
    subprocess.run(command, check=True, timeout=120, env={**os.environ, "ONEDNN_MAX_CPU_ISA": "AVX2"})
    # Ties are rounded differently.
    assert np.abs(np.load(outputs_file) - openvino_model.load(path).run(inputs[role])).mean() < 1e-4


def test_openvino_refuses_invalid_files_as_onnxruntime_does(tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("hello")
    for path, message in ((text, "not a model"), (tmp_path / "none.onnx", "no model file")):
        for module in (onnx_model, openvino_model):
            with pytest.raises(ModelError, match=message) as error:
                module.load(path)
            assert "\n" not in str(error.value)


def test_openvino_sends_no_telemetry(tmp_path: Path) -> None:
    """Its package reports every import to Google Analytics, with an identity that it keeps in the home folder."""
    program = (
        "import socket, sys\n"
        "def refuse(*_, **__): print('it looked up an address')\n"
        "socket.getaddrinfo = refuse\n"
        "from lanestream.inference.loading import load_model\n"
        f"model = load_model(__import__('pathlib').Path({str(SHIPPED_MODEL)!r}), 'openvino')\n"
        "print(model.placement.provider, 'openvino_telemetry' in sys.modules)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        check=True,
        env={"HOME": str(tmp_path), "PYTHONPATH": ":".join(sys.path)},
    )
    assert done.stdout == "openvino False\n"
    assert not (tmp_path / "intel").exists()


# OpenVINO's signal stack of the thread that loads a network is freed with the network.
INTERRUPT_AFTER_OPENVINO = """
import os, signal, sys, threading
from pathlib import Path
from lanestream.inference import openvino_model
networks = [openvino_model.load(Path(sys.argv[1]))]
thread = threading.Thread(target=networks.clear)
thread.start()
thread.join()
try:
    os.kill(os.getpid(), signal.SIGINT)
    signal.pause()
except KeyboardInterrupt:
    print("interrupted")
"""


def test_a_process_can_be_interrupted_after_another_thread_freed_a_network_of_openvino() -> None:
    command = [sys.executable, "-c", INTERRUPT_AFTER_OPENVINO, str(SHIPPED_MODEL)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert (result.returncode, result.stdout) == (0, "interrupted\n"), result.stderr
