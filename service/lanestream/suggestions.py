"""What would make the networks or the service faster on this machine: a table of conditions and advice.

Each row states a measured or documented fact; docs/providers.md has the measurements.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from lanestream.gpu import Gpu
from lanestream.host import Cpu
from lanestream.inference.providers import AUTO, CPU, CUDA, OPENVINO, TENSORRT
from lanestream.workers.process_pool import MOST_PROCESSES

_ON_GPU: Final = frozenset({CUDA.name, TENSORRT.name})


@dataclass(frozen=True)
class Findings:
    """What the advice depends on.

    `installed` are the providers that are built in, `asked` is the requested one, `runs_on` are those that really run
    networks and `precisions` the precisions of these. `skipped` says why better providers were passed over, if any
    were. `worker_limit` is the number of worker processes that the memory has room for.
    """

    cpu: Cpu
    gpu: Gpu
    installed: tuple[str, ...]
    asked: str
    runs_on: tuple[str, ...]
    precisions: tuple[str, ...]
    skipped: str | None
    worker_limit: int

    @property
    def amx(self) -> bool:
        """Whether the CPU multiplies int8 matrices in AMX tiles."""
        return "amx_int8" in self.cpu.flags

    @property
    def uses_gpu(self) -> bool:
        """Whether a GPU runs networks."""
        return not _ON_GPU.isdisjoint(self.runs_on)


@dataclass(frozen=True)
class Suggestion:
    """Advice in one line; `topic` is stable, for programs."""

    topic: str
    text: str


@dataclass(frozen=True)
class _Rule:
    topic: str
    applies: Callable[[Findings], bool]
    text: Callable[[Findings], str]


def suggestions(findings: Findings) -> tuple[Suggestion, ...]:
    """Returns the advice that applies here."""
    return tuple(Suggestion(rule.topic, rule.text(findings)) for rule in _RULES if rule.applies(findings))


def _cuda_is_broken(found: Findings) -> bool:
    wanted = found.asked in _ON_GPU or (found.asked == AUTO and found.skipped is not None)
    return CUDA.name in found.installed and wanted and not found.uses_gpu


def _repair_of_cuda(found: Findings) -> str:
    gpu = found.gpu
    if not gpu.devices and gpu.driver_cuda is None:
        what = "no NVIDIA GPU answers: install its driver, or start the container with access to it (`--gpus all`)"
    elif gpu.driver_cuda and gpu.onnxruntime_cuda and _number(gpu.driver_cuda) < _number(gpu.onnxruntime_cuda):
        what = (
            f"its driver supports CUDA {gpu.driver_cuda}, onnxruntime needs {gpu.onnxruntime_cuda}: update the driver"
        )
    elif gpu.cuda is None or gpu.cudnn is None:
        missing = " and ".join(name for name, found in (("CUDA", gpu.cuda), ("cuDNN", gpu.cudnn)) if found is None)
        what = f"{missing} can't be loaded: `pip install 'lanestream[gpu]'` installs CUDA and cuDNN"
    else:
        what = found.skipped or "`lanestream doctor --require cuda` reports why"
    return f"CUDA is installed but does not work; {what}"


def _number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".")[:2])


_RULES: Final = (
    _Rule(
        "gpu_build",
        lambda found: bool(found.gpu.devices) and CUDA.name not in found.installed,
        lambda found: (
            f"the GPU ({found.gpu.devices[0]}) is not used, because the installed onnxruntime is the one for CPUs: "
            "`pip uninstall onnxruntime`, then `pip install 'lanestream[service,gpu]'`"
        ),
    ),
    _Rule("cuda_broken", _cuda_is_broken, _repair_of_cuda),
    _Rule(
        "fp16",
        lambda found: found.uses_gpu and "int8" in found.precisions,
        lambda _: (
            "int8 files are made for CPUs; on a GPU use files in half precision: "
            "`lanestream export RUN/best.pt OUT.onnx --precision fp16`"
        ),
    ),
    _Rule(
        "openvino",
        lambda found: found.amx and OPENVINO.name not in found.installed and not found.uses_gpu,
        lambda _: (
            "this CPU has AMX, on which OpenVINO runs the networks up to 1.5 times as fast: "
            "`pip install 'lanestream[openvino]'` (180 MB), and `auto` takes it"
        ),
    ),
    _Rule(
        "openvino_unused",
        lambda found: found.amx and OPENVINO.name in found.installed and found.asked == CPU.name,
        lambda _: (
            "OpenVINO is installed and runs the networks up to 1.5 times as fast on this CPU with AMX: "
            "use the provider auto or openvino instead of cpu"
        ),
    ),
    _Rule(
        "onnxruntime",
        lambda found: found.asked == OPENVINO.name and "avx512_vnni" in found.cpu.flags and not found.amx,
        lambda _: "onnxruntime is a little faster on this CPU, which has VNNI but no AMX: use the provider auto or cpu",
    ),
    _Rule(
        "quota",
        lambda found: found.cpu.quota is not None and found.cpu.used < found.cpu.affinity,
        lambda found: (
            f"the container's quota allows {found.cpu.quota:g} of {found.cpu.affinity} processors; a higher one, "
            f"such as `docker run --cpus {found.cpu.affinity}`, allows more frames per second"
        ),
    ),
    _Rule(
        "memory",
        lambda found: found.worker_limit < min(found.cpu.used, MOST_PROCESSES) and not found.uses_gpu,
        lambda found: (
            f"the container's memory has room for {found.worker_limit} worker processes, not {found.cpu.used}; "
            "each needs 0.4 GB, and the service 0.3 GB"
        ),
    ),
)
