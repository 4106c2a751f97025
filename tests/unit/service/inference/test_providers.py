"""Which provider is taken, what is said of it, and that networks answer alike whichever runs them."""

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

from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR, load_engine
from lanestream.errors import ModelError, ProviderError
from lanestream.inference import LoadedModel, ModelInfo, OnnxModel, OpenVinoModel, load_model
from lanestream.inference.loaded_model import Placement
from lanestream.inference.onnx_model import CPU_BUCKETS, GPU_BUCKETS, BoundOnnxModel, tensorrt_options
from lanestream.inference.providers import Offer, attempts, offered
from lanestream.runtime import Provider, RuntimeOptions
from lanestream_exporter.scenes import render_still, sample_scene

CPU_ALONE = Offer(frozenset({"CPUExecutionProvider"}), openvino=False, amx=True)
WITH_CUDA = Offer(frozenset({"CUDAExecutionProvider", "CPUExecutionProvider"}), openvino=False, amx=True)
WITH_OPENVINO = Offer(frozenset({"CPUExecutionProvider"}), openvino=True, amx=True)
FP32_MODEL = SHIPPED_MODEL.with_name("classifier-fp32.onnx")


class Counting(LoadedModel):
    """Answers with the first pixel of each input, and remembers the batches it was asked for."""

    def __init__(self, info: ModelInfo, buckets: tuple[int, ...]) -> None:
        super().__init__(info, Placement("cpu", "a test", 1, {}, buckets))
        self.batches: list[NDArray[np.uint8]] = []

    def _outputs(self, inputs: NDArray[np.uint8]) -> NDArray[np.float32]:
        self.batches.append(inputs)
        return inputs[:, 0, 0, :2].astype(np.float32)


@pytest.fixture(scope="module")
def classifier() -> OnnxModel:
    return OnnxModel.load(SHIPPED_MODEL)


@pytest.fixture(scope="module")
def rendered() -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """What the shipped detectors ask of the classifier and of the regressor about rendered roads."""
    candidates, regression = load_engine(provider="cpu").pipelines
    rng = np.random.default_rng(11)
    stills = [render_still(sample_scene(rng, 640, 360)).image for _ in range(8)]
    patches, canvases = (
        np.concatenate([pipeline.detector.prepare(image).inputs for image in stills])
        for pipeline in (candidates, regression)
    )
    return patches, canvases


def numbered(count: int, size: int) -> NDArray[np.uint8]:
    inputs = np.zeros((count, size, size, 3), np.uint8)
    inputs[:, 0, 0, 0] = np.arange(1, count + 1)
    return inputs


@pytest.mark.parametrize(
    ("count", "batches"), [(0, []), (1, [1]), (3, [4]), (4, [4]), (9, [8, 1]), (11, [8, 4]), (16, [8, 8])]
)
def test_rows_are_padded_to_buckets_and_answered_in_order(
    classifier: OnnxModel, count: int, batches: list[int]
) -> None:
    network = Counting(classifier.info, (1, 2, 4, 8))
    outputs = network.run(numbered(count, classifier.info.input_size))
    assert outputs[:, 0].tolist() == list(range(1, count + 1))
    assert outputs.shape == (count, 2)
    assert [len(batch) for batch in network.batches] == batches


def test_a_batch_that_fits_is_not_copied(classifier: OnnxModel) -> None:
    network = Counting(classifier.info, CPU_BUCKETS)
    inputs = numbered(16, classifier.info.input_size)
    for count in CPU_BUCKETS:
        network.run(inputs[:count])
    assert all(np.shares_memory(batch, inputs) for batch in network.batches)


def test_every_bucket_is_warmed(classifier: OnnxModel) -> None:
    network = Counting(classifier.info, GPU_BUCKETS)
    network.warm_up()
    assert sorted(len(batch) for batch in network.batches) == list(GPU_BUCKETS)
    assert len(network.batches[0]) == GPU_BUCKETS[-1]


def test_auto_takes_the_cpu_where_there_is_nothing_else_and_says_why() -> None:
    network = load_model(SHIPPED_MODEL, "auto", offer=CPU_ALONE)
    assert not network.fell_back, "what is not installed is not missed"
    assert network.sha256 == hashlib.sha256(SHIPPED_MODEL.read_bytes()).hexdigest()
    assert network.provider == "cpu"
    assert network.reason.startswith("the installed onnxruntime has no CUDA; OpenVINO is not installed; ")


def test_auto_never_takes_tensorrt() -> None:
    for offer in (WITH_CUDA, WITH_OPENVINO, replace(WITH_OPENVINO, amx=False)):
        assert "tensorrt" not in attempts("auto", offer)


@pytest.mark.parametrize(("amx", "provider"), [(True, "openvino"), (False, "cpu")])
def test_auto_takes_openvino_where_the_cpu_has_amx(amx: bool, provider: Provider) -> None:
    network = load_model(SHIPPED_MODEL, "auto", offer=replace(WITH_OPENVINO, amx=amx))
    assert network.provider == provider
    assert "AMX" in network.reason
    assert not network.fell_back, "OpenVINO could be had"


def test_what_this_machine_offers_is_looked_up() -> None:
    assert offered().openvino
    assert offered().amx == ("amx_int8" in Path("/proc/cpuinfo").read_text())


# This build of onnxruntime has no CUDA: asked for it, it falls back in silence, as it does where a library is missing.
@pytest.mark.filterwarnings("ignore:Specified provider")
def test_cuda_that_is_built_in_and_does_not_work_is_found_out() -> None:
    with pytest.raises(ProviderError, match="CUDA can't be used: onnxruntime fell back to CPUExecutionProvider") as no:
        load_model(SHIPPED_MODEL, "cuda", offer=WITH_CUDA)
    assert "lanestream doctor" in no.value.hint
    network = load_model(SHIPPED_MODEL, "auto", offer=WITH_CUDA)
    assert (network.provider, network.fell_back) == ("cpu", True)
    assert "CUDA can't be used" in network.reason


@pytest.mark.parametrize(
    ("provider", "words"),
    [("cuda", "has no CUDA"), ("tensorrt", "has no TensorRT"), ("openvino", "OpenVINO is not installed")],
)
def test_a_provider_that_was_asked_for_and_is_not_installed_is_told_in_one_line(provider: Provider, words: str) -> None:
    with pytest.raises(ProviderError, match=words) as error:
        load_model(SHIPPED_MODEL, provider, offer=CPU_ALONE)
    assert "\n" not in str(error.value)
    assert "install" in error.value.hint


def test_without_openvino_installed_all_else_works(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    assert not offered().openvino
    assert load_model(SHIPPED_MODEL).provider == "cpu"
    with pytest.raises(ProviderError, match="OpenVINO can't be used"):
        OpenVinoModel.load(SHIPPED_MODEL)


@pytest.mark.parametrize("provider", ["cpu", "openvino"])
def test_threads_can_be_set(provider: Provider) -> None:
    network = load_model(SHIPPED_MODEL, provider, RuntimeOptions(threads=1))
    assert network.placement.threads == 1
    assert sum(network.placement.nodes.values()) > 10


def test_bound_buffers_answer_like_a_plain_run(
    classifier: OnnxModel, rendered: tuple[NDArray[np.uint8], NDArray[np.uint8]]
) -> None:
    """The way of a GPU, with buffers on the CPU: padded, more rows than the largest bucket, answers that stay."""

    class OnTheCpu(BoundOnnxModel):
        device = "cpu"

    session = onnxruntime.InferenceSession(str(SHIPPED_MODEL), providers=["CPUExecutionProvider"])
    network = OnTheCpu(session, classifier.info, Placement("cpu", "a test", 1, {}, (1, 2, 4, 8)))
    patches = rendered[0][:21]
    first, later = network.run(patches), network.run(patches[::-1])
    np.testing.assert_allclose(first, classifier.run(patches), atol=1e-6)
    np.testing.assert_allclose(later[::-1], first, atol=1e-6)


@pytest.mark.filterwarnings("ignore:Specified provider")
def test_a_bad_file_is_not_taken_for_the_gpus_fault(tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("hello")
    with pytest.raises(ModelError, match="not a model"):
        load_model(text, "cuda", offer=WITH_CUDA)


def test_tensorrt_keeps_the_precision_of_the_file(classifier: OnnxModel, tmp_path: Path) -> None:
    assert tensorrt_options(classifier.info, None) == {"trt_fp16_enable": "0"}
    half = classifier.info.model_copy(update={"precision": "fp16"})
    options = tensorrt_options(half, tmp_path)
    assert (options["trt_fp16_enable"], options["trt_engine_cache_path"]) == ("1", str(tmp_path))


def test_openvino_computes_what_onnxruntime_computes(rendered: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
    patches, canvases = rendered
    ours = {path: OnnxModel.load(path).run(patches) for path in (SHIPPED_MODEL, FP32_MODEL)}
    theirs = {path: OpenVinoModel.load(path).run(patches) for path in ours}

    apart = np.abs(theirs[FP32_MODEL] - ours[FP32_MODEL])
    # What an export may differ from PyTorch: bfloat16, OpenVINO's own choice where the CPU has it, is ten times worse.
    assert apart.mean() <= 1e-4
    assert apart.max() <= 1e-3

    # Ties are rounded differently. That is to be lost in what int8 itself costs.
    rounded = np.abs(ours[SHIPPED_MODEL] - ours[FP32_MODEL]).mean()
    apart = np.abs(theirs[SHIPPED_MODEL] - ours[SHIPPED_MODEL])
    assert apart.mean() <= 0.1 * rounded
    assert apart.max() <= 0.1

    readings = [kind.load(SHIPPED_REGRESSOR).run(canvases) for kind in (OnnxModel, OpenVinoModel)]
    apart = np.abs(readings[0] - readings[1])
    # A thirtieth of what an int8 export may differ from PyTorch.
    assert apart.mean() <= 1e-3
    assert apart.max() <= 0.02


OLDER = """
import sys
import numpy as np
from pathlib import Path
from lanestream.inference import OpenVinoModel
inputs = np.load(sys.argv[2])
np.save(sys.argv[3], OpenVinoModel.load(Path(sys.argv[1])).run(inputs))
"""


@pytest.mark.parametrize("path", [SHIPPED_MODEL, SHIPPED_REGRESSOR], ids=lambda path: path.stem)
def test_int8_answers_are_the_same_on_a_processor_without_vnni(
    path: Path, rendered: tuple[NDArray[np.uint8], NDArray[np.uint8]], tmp_path: Path
) -> None:
    """Such a one adds products in sixteen bits; weights of eight would make it cut off sums, and answer otherwise."""
    inputs = rendered[0 if path == SHIPPED_MODEL else 1]
    given, taken = tmp_path / "inputs.npy", tmp_path / "outputs.npy"
    np.save(given, inputs)
    command = [sys.executable, "-c", OLDER, str(path), str(given), str(taken)]
    subprocess.run(command, check=True, timeout=120, env={**os.environ, "ONEDNN_MAX_CPU_ISA": "AVX2"})
    # Ties are rounded differently.
    assert np.abs(np.load(taken) - OpenVinoModel.load(path).run(inputs)).mean() < 1e-4


def test_openvino_refuses_files_as_onnxruntime_does(tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("hello")
    for path, words in ((text, "not a model"), (tmp_path / "none.onnx", "no model file")):
        with pytest.raises(ModelError, match=words) as error:
            OpenVinoModel.load(path)
        assert "\n" not in str(error.value)


def test_openvino_tells_nobody_of_its_use(tmp_path: Path) -> None:
    """Its package sends every import to Google Analytics, with an identity that it keeps in the home directory."""
    program = (
        "import socket, sys\n"
        "def refuse(*_, **__): print('it looked up an address')\n"
        "socket.getaddrinfo = refuse\n"
        "from lanestream.inference import load_model\n"
        f"network = load_model(__import__('pathlib').Path({str(SHIPPED_MODEL)!r}), 'openvino')\n"
        "print(network.provider, 'openvino_telemetry' in sys.modules)\n"
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
