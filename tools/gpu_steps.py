"""The steps of `make gpu-check`. Each runs in a process of its own and returns what it measured."""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import onnxruntime
from bench.frames import Clips, load_clips
from bench.load_generator import generate
from bench.measure import Sample, measure_load, split_load, start_helper
from bench.runners import ProcessTree, Server, ServerProgram
from bench.workload import LARGE, LoadRequest
from numpy.typing import NDArray
from providers import network_inputs, rendered_scenes

from lanestream.detection.interface import ModelRole
from lanestream.engine import SHIPPED_MODEL, SHIPPED_REGRESSOR
from lanestream.gpu import gpu
from lanestream.host import processors
from lanestream.inference.loaded_model import LoadedModel, runtime_message
from lanestream.inference.loading import load_model
from lanestream.inference.model_info import ModelInfo
from lanestream.inference.onnx_model import GPU_BATCH_SIZES, preload_gpu_libraries, session_options, verify_provider
from lanestream.inference.providers import CUDA, DEFAULT_OPTIONS, ProviderSpec, find_provider

FP32_CLASSIFIER: Final = SHIPPED_MODEL.with_name("classifier-fp32.onnx")
# How far a GPU's outputs may be from a CPU's, by the precision of the file.
MOST_DIFFERENCE: Final = {"fp32": 1e-3, "fp16": 2e-2, "int8": 2e-2}
AIM_FPS: Final = 1000.0
AIM_P99_MS: Final = 30.0
# A service is loaded with this part of the frames that it can answer, to measure how long an answer takes.
PACE: Final = 0.8
_INPUTS_FILE: Final = "gpu_check_inputs.npz"

Inputs = NDArray[np.uint8]
Outputs = NDArray[np.float32]


@dataclass(frozen=True)
class Plan:
    """What to check: networks on a provider, with files in `folder`.

    `frames` is a video or a folder of images, None for rendered roads. `models` are files to check besides the shipped
    ones. `sessions` is the number of cameras of the load. A `quick` plan measures less, to see that it works.
    """

    provider: str
    folder: Path
    frames: str | None = None
    models: tuple[Path, ...] = ()
    sessions: int = 32
    quick: bool = False

    @property
    def half_precision_file(self) -> Path:
        """The copy of the shipped classifier in half precision, which step `inputs` writes."""
        return self.folder / "classifier-fp16.onnx"

    @property
    def files(self) -> list[Path]:
        """All model files to check."""
        half = [self.half_precision_file] if self.half_precision_file.exists() else []
        return [SHIPPED_MODEL, FP32_CLASSIFIER, *half, SHIPPED_REGRESSOR, *self.models]

    @property
    def runs(self) -> int:
        """How often a network runs for the median of its times."""
        return 3 if self.quick else 50

    @property
    def batches(self) -> tuple[int, ...]:
        """The batch sizes that are timed."""
        return (1, 4) if self.quick else GPU_BATCH_SIZES

    @property
    def bound_batches(self) -> tuple[int, ...]:
        """The batch sizes that run with bound buffers."""
        return (1, 4) if self.quick else (1, 8, 64)

    @property
    def seconds(self) -> float:
        """For how long a load is measured."""
        return 0.2 if self.quick else 8.0

    @property
    def pictures(self) -> int:
        """How many pictures of `frames` the networks get, and twice as many as a camera of the load sends."""
        return 8 if self.quick else 48


@dataclass
class Report:
    """What a step found: `lines` for people and `figures` for programs; `failures` are lines, too.

    `skipped` says why a step did nothing; None if it ran.
    """

    lines: list[str] = field(default_factory=list)
    figures: dict[str, Any] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)
    skipped: str | None = None


def doctor(plan: Plan) -> Report:
    """Runs `lanestream doctor --require PROVIDER`: whether the shipped networks run there."""
    command = [sys.executable, "-m", "lanestream", "doctor", "--require", plan.provider, "--json"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    report = Report()
    with suppress(ValueError):
        report.figures = json.loads(result.stdout)
    if result.returncode:
        message = result.stderr.strip().rpartition("\n")[2] or f"exit code {result.returncode}"
        report.failures.append(message.removeprefix("error: "))
    for network in report.figures.get("networks", ()):
        counts = ", ".join(f"{count} nodes on {where}" for where, count in network["nodes"].items())
        report.lines.append(f"{network['name']}, {network['precision']}: {counts}")
    return report


def inputs(plan: Plan) -> Report:
    """Writes what the networks get for real or rendered pictures, and a classifier in half precision."""
    images = rendered_scenes()
    if plan.frames is not None:
        files = load_clips([LARGE], plan.pictures, plan.frames)[LARGE]
        images = [np.asarray(cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR), np.uint8) for file in files]
    recorded = network_inputs(images)
    np.savez(plan.folder / _INPUTS_FILE, **{str(role): batch for role, batch in recorded.items()})
    if find_spec("onnx") is not None:
        from half_precision import write_half_precision

        write_half_precision(FP32_CLASSIFIER, plan.half_precision_file)
    counts = {str(role): len(batch) for role, batch in recorded.items()}
    line = f"{len(images)} pictures: {counts['classifier']} patches, {counts['regressor']} road crops"
    return Report([line], {"pictures": len(images), **counts})


def nodes(plan: Plan) -> Report:
    """Counts, from onnxruntime's profile of a run, the nodes that another provider ran than the one that was asked."""
    report, spec = Report(), find_provider(plan.provider)
    for path in plan.files:
        ran = profiled_nodes(path, spec, plan.folder)
        elsewhere = Counter(operator for operator, provider in ran if provider != spec.onnxruntime_name)
        copies = sum(operator.startswith("Memcpy") for operator, _ in ran)
        report.figures[path.name] = {"nodes": len(ran), "elsewhere": dict(elsewhere), "copies": copies}
        report.lines.append(f"{path.name}: {len(ran)} nodes, {elsewhere.total()} not on {spec.name}, {copies} copies")
        if elsewhere:
            operators = ", ".join(f"{count} {operator}" for operator, count in elsewhere.most_common())
            report.failures.append(f"{path.name}: nodes that did not run on {spec.name}: {operators}")
    return report


def parity(plan: Plan) -> Report:
    """Compares the outputs on the provider with those on the CPU."""
    report = compared(plan, plan.provider)
    checked = {each["precision"] for each in report.figures.values()}
    for precision in MOST_DIFFERENCE.keys() - checked:
        report.failures.append(f"no {precision} file was checked: install onnx, or give a file with --model")
    if plan.provider == CUDA.name:
        _compare_without_tf32(plan, report)
    return report


def batches(plan: Plan) -> Report:
    """Times the networks in batches of 1 to 64, as the service runs them."""
    return timed(plan, plan.provider)


def binding(plan: Plan) -> Report:
    """Times each network without and with bound buffers on the device, and as a CUDA graph.

    A CUDA graph has fixed shapes and addresses: each batch size has a session of its own.
    """
    report, spec = Report(), find_provider(plan.provider)
    for path in plan.files:
        info = load_model(path, "cpu").info
        for size in plan.bound_batches:
            batch = recorded_inputs(plan, info.kind, size)
            runs = dict(_runs(path, info, spec, size, report))
            times = {name: median_ms(partial(run, batch), plan.runs) for name, run in runs.items()}
            cells = ", ".join(f"{name} {milliseconds:.3f}" for name, milliseconds in times.items())
            report.figures[f"{path.name}, {size}"] = times
            report.lines.append(f"{path.name}, batch of {size}: {cells} ms")
            for name, run in runs.items():
                # What was captured or bound with other inputs has to see new ones.
                run(np.zeros_like(batch))
                difference = float(np.abs(run(batch) - runs["plain"](batch)).max())
                if not difference <= MOST_DIFFERENCE[info.precision]:
                    report.failures.append(f"{path.name}: {name} runs of {size} differ by {difference:.6f} from plain")
    if spec is not CUDA:
        report.lines.append(f"no CUDA graphs: the provider is {spec.name}")
    return report


def tensorrt(plan: Plan) -> Report:
    """Compares and times TensorRT, if its libraries are there."""
    if plan.provider != CUDA.name:
        return Report(skipped=f"the provider is {plan.provider}")
    if gpu().tensorrt is None:
        return Report(skipped="TensorRT's libraries are not installed")
    found = (compared(plan, "tensorrt"), timed(plan, "tensorrt"))
    return Report(
        [line for each in found for line in each.lines],
        {"parity": found[0].figures, "batches": found[1].figures},
        [line for each in found for line in each.failures],
    )


def load(plan: Plan) -> Report:
    """Loads services with cameras of 1280 x 720: as many frames as they can answer, then a part of that.

    One worker process runs the networks of all cameras on a GPU by default; more of them use more processors.
    """
    report = Report()
    half = find_provider(plan.provider).on_gpu and plan.half_precision_file.exists()
    model = plan.half_precision_file if half else SHIPPED_MODEL
    clips = load_clips([LARGE], plan.pictures // 2, plan.frames)
    counts: list[int | None] = [None] if plan.quick else [None, max(2, processors() // 4), max(3, processors() // 2)]
    for count in counts:
        name = "the default number of worker processes" if count is None else f"{count} worker processes"
        figures = _load_service(plan, model, clips, count)
        report.figures["default" if count is None else str(count)] = figures
        for kind, each in figures.items():
            report.lines.append(
                f"{name}, {kind}: {each['fps']:.0f} frames/s, p50 {each['p50_ms']:.1f} ms, p99 {each['p99_ms']:.1f} ms,"
                f" {each['cpu_ms_per_frame']:.1f} ms of processor time per frame,"
                f" load generators {100 * each['generator_share']:.0f} % of the processors"
            )
            if each["failed"]:
                report.failures.append(f"{name}, {kind}: {each['failed']} frames failed")
    best = max(figures["most"]["fps"] for figures in report.figures.values())
    p99 = min(figures["paced"]["p99_ms"] for figures in report.figures.values())
    report.figures |= {"aim_fps": AIM_FPS, "aim_p99_ms": AIM_P99_MS, "model": model.name, "sessions": plan.sessions}
    report.lines.append(f"{plan.sessions} cameras, {model.name}: {best:.0f} frames/s (aim {AIM_FPS:.0f} or more)")
    report.lines.append(f"p99 at {PACE:.0%} of the most frames: {p99:.1f} ms (aim below {AIM_P99_MS:.0f})")
    return report


def compared(plan: Plan, provider: str) -> Report:
    """Compares the outputs of all files on `provider` with those on the CPU, for the recorded inputs."""
    report = Report()
    for path in plan.files:
        expected, network = load_model(path, "cpu"), load_model(path, provider)
        batch = recorded_inputs(plan, network.info.kind, 16 if plan.quick else None)
        precision = network.info.precision
        difference = np.abs(network.run(batch) - expected.run(batch))
        mean, largest = float(difference.mean()), float(difference.max())
        most = MOST_DIFFERENCE[precision]
        report.figures[path.name] = {"precision": precision, "mean": mean, "largest": largest, "most": most}
        line = f"{path.name}, {precision}, {len(batch)} inputs: largest difference {largest:.6f}, mean {mean:.6f}"
        report.lines.append(line)
        if not largest <= most:
            report.failures.append(
                f"{path.name}: outputs differ by {largest:.6f} from those on a CPU, at most {most:g}"
            )
    return report


def timed(plan: Plan, provider: str) -> Report:
    """Times all files on `provider` by batch size, as the service runs them."""
    report = Report([_row("batch of", plan.batches)])
    for path in plan.files:
        started = time.perf_counter()
        network = load_model(path, provider)
        network.warm_up()
        ready_s = time.perf_counter() - started
        times = {size: _batch_ms(plan, network, size) for size in plan.batches}
        report.figures[path.name] = {"ready_s": ready_s, "ms": times}
        report.lines.append(_row(f"{path.name}, ms", (f"{ms:.2f}" for ms in times.values())))
        report.lines.append(_row("inputs/s", (f"{1e3 * size / ms:.0f}" for size, ms in times.items())))
        report.lines.append(_row("ready after", (f"{ready_s:.1f} s",)))
    return report


def recorded_inputs(plan: Plan, role: ModelRole, count: int | None = None) -> Inputs:
    """Returns the inputs that step `inputs` wrote: all of them, or the first `count`, repeated if there are fewer."""
    with np.load(plan.folder / _INPUTS_FILE) as file:
        found: Inputs = file[role]
    return found if count is None else found[np.arange(count) % len(found)]


def open_session(
    path: Path, spec: ProviderSpec, info: ModelInfo, extra: Mapping[str, str] | None = None, *, profile: str = ""
) -> Any:
    """Returns onnxruntime's session on the provider with the service's options and `extra` ones of the provider.

    With a `profile`, it writes a file whose path begins like this. Raises ProviderError if it fell back to another
    provider.
    """
    if spec.on_gpu:
        preload_gpu_libraries()
    options = session_options(DEFAULT_OPTIONS.threads)
    if profile:
        options.enable_profiling, options.profile_file_prefix = True, profile
    provider = (spec.onnxruntime_name, {**spec.options(info, DEFAULT_OPTIONS), **(extra or {})})
    # onnxruntime adds the CPU itself.
    session = onnxruntime.InferenceSession(str(path), options, providers=[provider], enable_fallback=False)
    verify_provider(spec, session.get_providers())
    return session


def profiled_nodes(path: Path, spec: ProviderSpec, folder: Path) -> list[tuple[str, str]]:
    """Returns operator and provider of each node that ran, in a run of one batch, and of each copy between devices."""
    info = load_model(path, "cpu").info
    session = open_session(path, spec, info, profile=str(folder / "profile"))
    session.run(None, {session.get_inputs()[0].name: np.zeros((8, info.input_size, info.input_size, 3), np.uint8)})
    profile = Path(session.end_profiling())
    events = json.loads(profile.read_text(encoding="utf-8"))
    profile.unlink()
    ran = [event["args"] for event in events if event.get("cat") == "Node" and event["name"].endswith("_kernel_time")]
    return [(each["op_name"], each["provider"]) for each in ran]


def median_ms(run: Callable[[], object], runs: int) -> float:
    """Returns the median of the milliseconds of some runs, after three that do not count."""
    for _ in range(3):
        run()
    times = []
    for _ in range(runs):
        started = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - started))
    return statistics.median(times)


def _row(name: str, cells: Iterable[object]) -> str:
    return f"{name:26}" + "".join(f"{cell:>9}" for cell in cells)


def _batch_ms(plan: Plan, network: LoadedModel, size: int) -> float:
    batch = recorded_inputs(plan, network.info.kind, size)
    return median_ms(lambda: network.run(batch), plan.runs)


def _compare_without_tf32(plan: Plan, report: Report) -> None:
    """Adds how far single precision is off without TF32, which CUDA uses by default."""
    network = load_model(FP32_CLASSIFIER, "cpu")
    session = open_session(FP32_CLASSIFIER, CUDA, network.info, extra={"use_tf32": "0"})
    batch = recorded_inputs(plan, network.info.kind, 64)
    outputs = session.run(None, {session.get_inputs()[0].name: batch})[0]
    largest = float(np.abs(outputs - network.run(batch)).max())
    report.figures["largest_without_tf32"] = largest
    report.lines.append(f"{FP32_CLASSIFIER.name} without TF32: largest difference {largest:.6f}")


def _runs(
    path: Path, info: ModelInfo, spec: ProviderSpec, size: int, report: Report
) -> Iterator[tuple[str, Callable[[Inputs], Outputs]]]:
    """Yields the ways to run a batch of `size` by their names."""
    session = open_session(path, spec, info)
    name = session.get_inputs()[0].name
    yield "plain", lambda batch: session.run(None, {name: batch})[0]
    device = "cuda" if spec.on_gpu else "cpu"
    yield "bound", bound_run(session, info, size, device)
    if spec is CUDA:
        try:
            captured = bound_run(open_session(path, spec, info, extra={"enable_cuda_graph": "1"}), info, size, device)
            # The first run allocates, and a later one is captured.
            captured(np.zeros((size, info.input_size, info.input_size, 3), np.uint8))
        except Exception as error:  # onnxruntime raises a type per status, all of them private
            report.lines.append(f"{path.name}: no CUDA graph of a batch of {size}: {runtime_message(error)}")
        else:
            yield "graph", captured


def bound_run(session: Any, info: ModelInfo, size: int, device: str) -> Callable[[Inputs], Outputs]:
    """Returns a function that runs batches of `size` with buffers on the device: copies in, runs, copies out."""
    make = onnxruntime.OrtValue.ortvalue_from_shape_and_type
    source = make([size, info.input_size, info.input_size, 3], np.uint8, device, 0)
    target = make([size, info.outputs], np.float32, device, 0)
    bound = session.io_binding()
    bound.bind_ortvalue_input(session.get_inputs()[0].name, source)
    bound.bind_ortvalue_output(session.get_outputs()[0].name, target)

    def run(batch: Inputs) -> Outputs:
        source.update_inplace(np.ascontiguousarray(batch))
        session.run_with_iobinding(bound)
        return np.array(target.numpy(), np.float32)

    return run


def _load_service(plan: Plan, model: Path, clips: Clips, processes: int | None) -> dict[str, Any]:
    """Returns the figures of a service under most frames and under a paced load."""
    command = (sys.executable, "-m", "lanestream", "serve", "--provider", plan.provider, "--model", model)
    environment = {} if processes is None else {"LANESTREAM_PROCESSES": str(processes)}
    program = ServerProgram("gpu_check_service", "lanestream", command, "/readyz", "ws", "/v1/stream", environment)
    with ExitStack() as stack:
        generators = [start_helper(stack, generate, clips) for _ in range(max(2, processors() // 4))]
        for generator in generators:
            generator.wait_until_ready()
        server = Server(program, plan.folder)
        stack.callback(server.close)
        server.wait_until_ready()
        trees = [ProcessTree(generator.pid) for generator in generators]

        def measured(request: LoadRequest) -> Sample:
            return measure_load(server.processes, split_load(request, generators), trees, plan.seconds)

        request = LoadRequest(LARGE, plan.sessions, in_flight=2, url=server.url)
        most = measured(request)
        paced = measured(LoadRequest(LARGE, plan.sessions, rate=PACE * most.fps / plan.sessions, url=server.url))
    return {"most": _load_figures(most), "paced": _load_figures(paced)}


def _load_figures(sample: Sample) -> dict[str, Any]:
    if not sample.replies:
        raise RuntimeError("the service answered no frame")
    p50, p99 = np.percentile(sample.milliseconds, (50, 99))
    return {
        "fps": sample.fps,
        "p50_ms": float(p50),
        "p99_ms": float(p99),
        "cpu_ms_per_frame": sample.cpu_ms_per_frame,
        "memory_mb": sample.memory_mb,
        "generator_share": sample.generator_share,
        "replies": len(sample.replies),
        "failed": sample.failed,
    }
