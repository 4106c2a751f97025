"""Tables of the main figures of tracking for the terminal, each system beside the other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from rich import box
from rich.table import Table
from rich.text import Text

# A column: its title and the path of its figure, with dots.
_Column = tuple[str, str]

_RENDERED: Final[Mapping[str, Sequence[_Column]]] = {
    "Identity and lane changes": (
        ("clips", "clips"),
        ("ego sw.", "identity.ego_switches"),
        ("outer sw.", "identity.outer_switches"),
        ("IDF1", "identity.idf1"),
        ("frag.", "identity.fragmentations"),
        ("crossings", "roles.crossings"),
        ("role on time", "roles.on_time_share"),
        ("median s", "roles.median_delay_s"),
        ("right events", "events.right"),
        ("late", "events.late"),
        ("missed", "events.missed"),
        ("false", "events.false"),
    ),
    "Errors in lane widths": (
        ("bottom rms", "errors.bottom.rms"),
        (">0.1", "errors.bottom.large_share"),
        ("0.6 rms", "errors.middle.rms"),
        ("0.3 rms", "errors.far.rms"),
        (">0.1", "errors.far.large_share"),
        ("change >0.1", "lane_change.bottom.large_share"),
        ("settling s", "lane_change.median_settling_s"),
        ("followed", "errors.followed.share"),
        ("both ego", "errors.both_ego.share"),
        ("jumps", "jumps.bottom.jumps"),
        ("at 0.3", "jumps.far.jumps"),
    ),
    "Tracks that follow nothing, and cuts": (
        ("minutes", "ghosts.minutes"),
        ("ghosts", "ghosts.ghosts"),
        ("a minute", "ghosts.ghosts_per_minute"),
        ("frames", "ghosts.ghost_frames"),
        ("cuts", "cuts.cuts"),
        ("old ids", "cuts.old_id_boundaries"),
        ("ghosts after", "cuts.ghost_boundaries"),
        ("frames to ego", "cuts.median_frames_to_ego"),
        ("events", "cuts.events"),
        ("false", "cuts.false_events"),
    ),
    "Uncertainty: NEES per degree of freedom, coverage of the 95 % band": (
        ("NIS", "uncertainty.nis.per_dof"),
        *(
            (f"{state[:4]}. {title}", f"uncertainty.{state}.{key}")
            for state in ("detected", "inferred", "predicted")
            for title, key in (
                ("NEES", "nees_per_dof"),
                ("bottom", "coverage.bottom.share"),
                ("0.3", "coverage.far.share"),
            )
        ),
    ),
    "Jitter in px at 640 and lag in frames; meters with the true camera": (
        ("rms", "motion.jitter.rms_px_640"),
        ("mad", "motion.jitter.mad_px_640"),
        ("lag bottom", "motion.lag.bottom.lag_frames"),
        ("0.3", "motion.lag.far.lag_frames"),
        ("offset cm", "meters.offset_cm.rms"),
        ("width cm", "meters.lane_width_cm.rms"),
        ("heading deg", "meters.heading_deg.rms"),
        ("bias", "meters.heading_deg.bias"),
        ("1/m", "meters.curvature_per_m.rms"),
        ("pitch deg", "calibration.pitch_deg.rms"),
        ("yaw deg", "calibration.yaw_deg.rms"),
    ),
    "Kind, type and color after 2 s": (
        ("values", "appearance.type.values"),
        ("kind", "appearance.kind.share"),
        ("type", "appearance.type.share"),
        ("tracks", "appearance.type.track_share"),
        ("color", "appearance.color.share"),
        ("tracks", "appearance.color.track_share"),
    ),
    "Departures": (
        ("crossings", "departure.crossings"),
        ("warned", "departure.warned"),
        ("missed", "departure.missed"),
        ("lead s", "departure.median_lead_s"),
        ("warnings", "departure.warnings"),
        ("false", "departure.false_warnings"),
    ),
}
_GAPS: Final = ("gaps", "same_id", "held_to_end", "small_errors", "median_end_error", "p90_end_error")
_REAL: Final[Sequence[_Column]] = (
    ("frames", "frames"),
    ("switches", "id_switches"),
    ("both ego", "both_ego.share"),
    ("2nd half", "both_ego_second_half.share"),
    ("tracked px", "errors.tracked.mean_px_640"),
    ("alone", "errors.alone.mean_px_640"),
    ("detections", "errors.detections.mean_px_640"),
    ("paired", "errors.paired.tracked_mean_px_640"),
    ("detections", "errors.paired.detections_mean_px_640"),
    ("cov. bottom", "uncertainty.all.coverage.bottom.share"),
    ("0.3", "uncertainty.all.coverage.far.share"),
    ("jitter", "motion.jitter.rms_px_640"),
    ("mad", "motion.jitter.mad_px_640"),
    ("lag bottom", "motion.lag.bottom.lag_frames"),
    ("0.3", "motion.lag.far.lag_frames"),
    ("type", "appearance.type.share"),
    ("color", "appearance.color.share"),
)


def tracking_tables(figures: Mapping[str, Any]) -> Iterator[Table]:
    """Yields the tables, with a section per kind of clip and a row per system."""
    rendered, real = figures["rendered"], figures["real"]
    if rendered:
        for title, columns in _RENDERED.items():
            yield _table(title, columns, rendered)
        yield _gap_table(rendered)
    if real:
        yield _table("Labeled real clips", _REAL, real)


def _table(title: str, columns: Sequence[_Column], systems: Mapping[str, Any]) -> Table:
    table = _empty(title, [name for name, _ in columns])
    for part in next(iter(systems.values())):
        table.add_row(Text(part, style="bold"))
        for system, parts in systems.items():
            table.add_row(Text(f" {system}"), *(_cell(_at(parts[part], path)) for _, path in columns))
    return table


def _gap_table(systems: Mapping[str, Any]) -> Table:
    table = _empty("Hidden boundaries by the length of the gap in frames", _GAPS)
    overall = {system: parts["overall"]["gaps"] for system, parts in systems.items()}
    for length in next(iter(overall.values())):
        table.add_row(Text(length, style="bold"))
        for system, gaps in overall.items():
            table.add_row(Text(f" {system}"), *(_cell(gaps[length][key]) for key in _GAPS))
    return table


def _empty(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("")
    for column in columns:
        table.add_column(column, justify="right")
    return table


def _at(figures: Any, path: str) -> Any:
    """Returns the figure at a path, with dots between its keys."""
    for key in path.split("."):
        figures = figures[key]
    return figures


def _cell(value: float | None) -> str:
    if value is None:
        return "-"
    return str(value) if isinstance(value, int) else f"{value:.3f}"
