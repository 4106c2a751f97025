"""Assembles all figures; docs/evaluation.md documents every key."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

from lanestream_exporter.evaluation.tracking.accuracy import error_figures, lane_change_figures
from lanestream_exporter.evaluation.tracking.appearance import appearance_figures
from lanestream_exporter.evaluation.tracking.comparison import ClipRun, rounded
from lanestream_exporter.evaluation.tracking.departures import departure_figures
from lanestream_exporter.evaluation.tracking.gaps import gap_figures
from lanestream_exporter.evaluation.tracking.ghosts import cut_figures, ghost_figures, jump_figures
from lanestream_exporter.evaluation.tracking.identity import identity_figures
from lanestream_exporter.evaluation.tracking.meters import calibration_figures, meter_figures
from lanestream_exporter.evaluation.tracking.motion import motion_figures
from lanestream_exporter.evaluation.tracking.rendered import RenderedSet, Runs
from lanestream_exporter.evaluation.tracking.roles import event_figures, role_figures
from lanestream_exporter.evaluation.tracking.uncertainty import uncertainty_figures

SCHEMA: Final = 2
OVERALL: Final = "overall"

# The groups of figures of rendered clips. A new group is one more entry here.
_GROUPS: Final[Mapping[str, Callable[[Sequence[ClipRun]], dict[str, Any]]]] = {
    "identity": identity_figures,
    "roles": role_figures,
    "events": event_figures,
    "errors": error_figures,
    "lane_change": lane_change_figures,
    "gaps": gap_figures,
    "ghosts": ghost_figures,
    "cuts": cut_figures,
    "jumps": jump_figures,
    "uncertainty": uncertainty_figures,
    "motion": motion_figures,
    "meters": meter_figures,
    "calibration": calibration_figures,
    "departure": departure_figures,
    "appearance": appearance_figures,
}


def all_figures(
    systems: Mapping[str, Mapping[str, str]], rendered: RenderedSet, runs: Runs, real: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Returns everything that is written to the JSON file. `systems` are their descriptions by name."""
    return {
        "schema": SCHEMA,
        "systems": {name: dict(description) for name, description in systems.items()},
        "seeds": [rendered.seeds.start, rendered.seeds.stop],
        "calibrate": rendered.calibrate,
        "rendered": {name: rendered_figures(of_system) for name, of_system in runs.items() if of_system},
        "real": {name: dict(clips) for name, clips in real.items() if clips},
    }


def rendered_figures(runs: Sequence[ClipRun]) -> dict[str, Any]:
    """Returns all groups of figures for each kind of clip, and for all clips together as `overall`."""
    kinds: dict[str, list[ClipRun]] = {}
    for run in runs:
        kinds.setdefault(run.kind, []).append(run)
    return {kind: _groups(part) for kind, part in {**kinds, OVERALL: list(runs)}.items()}


def _groups(runs: Sequence[ClipRun]) -> dict[str, Any]:
    return {
        "clips": len(runs),
        "frames": sum(len(run.frames) for run in runs),
        "seconds": rounded(sum(run.seconds for run in runs), 2),
        **{name: figures(runs) for name, figures in _GROUPS.items()},
    }
