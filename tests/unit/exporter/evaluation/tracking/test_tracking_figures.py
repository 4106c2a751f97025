"""Every figure of tracking on synthetic clips with known answers."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest
from trackingruns import FPS, LANE_WIDTH, PAIR, Reported, TrueLane, run

from lanestream_exporter.evaluation.tracking.accuracy import error_figures, lane_change_figures
from lanestream_exporter.evaluation.tracking.appearance import appearance_figures
from lanestream_exporter.evaluation.tracking.comparison import ClipRun
from lanestream_exporter.evaluation.tracking.departures import departure_figures
from lanestream_exporter.evaluation.tracking.gaps import gap_figures
from lanestream_exporter.evaluation.tracking.ghosts import cut_figures, ghost_figures, jump_figures
from lanestream_exporter.evaluation.tracking.identity import identity_figures
from lanestream_exporter.evaluation.tracking.meters import calibration_figures, meter_figures
from lanestream_exporter.evaluation.tracking.motion import lag, motion_figures
from lanestream_exporter.evaluation.tracking.roles import event_figures, role_figures
from lanestream_exporter.evaluation.tracking.uncertainty import uncertainty_figures

EGO = (Reported(1, -0.5), Reported(2, 0.5))
# The true crossing of the lane changes below, between frames 40 and 41.
CROSSING = 40.5 / FPS


# Identity


def test_perfect_tracks_have_no_switches_and_an_idf1_of_one() -> None:
    figures = identity_figures([run(20, lambda _: EGO)])
    assert (figures["ego_switches"], figures["outer_switches"], figures["fragmentations"]) == (0, 0, 0)
    assert (figures["idf1"], figures["boundaries"], figures["id_true_positives"]) == (1.0, 2, 40)


def test_a_new_id_halfway_is_one_ego_switch_and_halves_that_identity() -> None:
    figures = identity_figures([run(20, lambda n: (Reported(1 if n < 10 else 7, -0.5), EGO[1]))])
    assert (figures["ego_switches"], figures["outer_switches"]) == (1, 0)
    assert figures["idf1"] == 0.75
    assert (figures["id_false_positives"], figures["id_false_negatives"]) == (10, 10)


def test_a_switch_of_an_outer_boundary_is_counted_apart_and_across_frames_without_it() -> None:
    outer = TrueLane(3, 0.7, position=2)  # inside the image over more rows than in a real scene

    def answer(n: int) -> tuple[Reported, ...]:
        return () if 8 <= n < 12 else (Reported(5 if n < 8 else 6, 0.7, 2),)

    figures = identity_figures([run(20, answer, lambda _: (outer,))])
    assert (figures["ego_switches"], figures["outer_switches"], figures["fragmentations"]) == (0, 1, 1)


def test_tracks_that_swap_their_boundaries_are_two_switches() -> None:
    figures = identity_figures([run(20, lambda n: EGO if n < 10 else (Reported(2, -0.5), Reported(1, 0.5)))])
    assert figures["ego_switches"] == 2
    assert figures["idf1"] == 0.5


def test_an_answer_beyond_the_gate_follows_nothing() -> None:
    near, far = (error_figures([run(5, lambda _, p=p: (Reported(1, p),))]) for p in (-0.5 + 0.34, -0.5 + 0.36))
    assert near["followed"] == {"ego_boundaries": 10, "followed": 5, "share": 0.5}
    assert far["followed"]["followed"] == 0


# Lane changes: the camera moves two lanes' boundaries from one side to the other at 1 lane width a second


def lane_change(role_frame: int, event_frame: int | None = None, **event: Any) -> ClipRun:
    """Returns a change to the left whose boundary 1 gets its new role at `role_frame`."""

    def moved(n: int) -> float:
        return (n - 40.5) / FPS

    def truth(n: int) -> tuple[TrueLane, ...]:
        return (TrueLane(1, moved(n)), TrueLane(2, moved(n) + 1.0, position=1 if moved(n) < 0.0 else 2))

    def answer(n: int) -> tuple[Reported, ...]:
        return (Reported(1, moved(n), 1 if n >= role_frame else -1), Reported(2, moved(n) + 1.0, 2))

    true_event = {"type": "lane_change", "direction": "left", "lane_id": 1, "timestamp": CROSSING}
    reported = {"type": "lane_change", "direction": "left", "track_id": 1, **event}
    return run(
        81,
        answer,
        truth,
        lambda n: {"events": [true_event] if n == 41 else []},
        lambda n: {"events": [reported] if n == event_frame else []},
    )


@pytest.mark.parametrize(
    ("role_frame", "delay_s", "frames", "on_time"),
    [(41, 0.0, 0, 1), (43, 0.1, 2, 1), (45, 0.18, 4, 0), (39, -0.06, -2, 1), (36, -0.18, -5, 0)],
)
def test_the_role_delay_is_the_time_from_the_crossing_to_the_new_role(
    role_frame: int, delay_s: float, frames: int, on_time: int
) -> None:
    figures = role_figures([lane_change(role_frame)])
    assert (figures["crossings"], figures["changed"], figures["on_time"]) == (1, 1, on_time)
    assert figures["median_delay_s"] == pytest.approx(delay_s, abs=1e-6)
    assert figures["median_delay_frames"] == frames


def test_a_role_that_never_changes_is_not_on_time() -> None:
    figures = role_figures([lane_change(1000)])
    assert (figures["crossings"], figures["changed"], figures["on_time_share"]) == (1, 0, 0.0)


@pytest.mark.parametrize(
    ("event_frame", "fields", "expected"),
    [
        (42, {}, {"right": 1, "late": 0, "missed": 0, "false": 0}),
        (45, {}, {"right": 0, "late": 1, "missed": 0, "false": 0}),
        # An event reported later has the interpolated time of the crossing.
        (45, {"timestamp": CROSSING + 0.01}, {"right": 1, "late": 0, "missed": 0, "false": 0}),
        (None, {}, {"right": 0, "late": 0, "missed": 1, "false": 0}),
        (42, {"direction": "right"}, {"right": 0, "late": 0, "missed": 1, "false": 1}),
    ],
)
def test_events_are_right_late_missed_or_false(
    event_frame: int | None, fields: dict[str, Any], expected: dict[str, int]
) -> None:
    figures = event_figures([lane_change(41, event_frame, **fields)])
    assert {key: figures[key] for key in expected} == expected
    assert figures["crossings"] == 1


def test_an_event_on_a_clip_without_a_crossing_is_false() -> None:
    event = {"type": "lane_change", "direction": "left", "track_id": 1}
    figures = event_figures([run(20, lambda _: EGO, message_fields=lambda n: {"events": [event] if n == 5 else []})])
    assert (figures["events"], figures["false"], figures["right_share"]) == (1, 1, None)


def test_errors_in_a_lane_change_settle_when_the_last_large_one_is_over() -> None:
    change = lane_change(41)
    assert lane_change_figures([change])["median_settling_s"] == 0.0

    def late(n: int) -> tuple[Reported, ...]:
        error = 0.2 if n <= 50 else 0.02
        return (Reported(1, (n - 40.5) / FPS + error, 1),)

    events = [{"type": "lane_change", "direction": "left", "lane_id": 1, "timestamp": CROSSING}]
    slow = run(81, late, lambda n: (TrueLane(1, (n - 40.5) / FPS),), lambda n: {"events": events if n == 41 else []})
    figures = lane_change_figures([slow])
    assert figures["median_settling_s"] == pytest.approx(9.5 / FPS, abs=1e-4)
    assert figures["bottom"]["values"] < 81  # beside the image at the end
    assert 0.3 < figures["far"]["large_share"] < 0.7


# Errors


def test_errors_are_in_lane_widths_at_every_row() -> None:
    figures = error_figures([run(10, lambda n: (Reported(1, -0.5 + (0.11 if n < 5 else 0.09)), EGO[1]))])
    for row in ("bottom", "middle", "far"):
        part = figures[row]
        assert (part["values"], part["large"], part["large_share"]) == (20, 5, 0.25)
        assert part["most"] == pytest.approx(0.11, abs=1e-4)
        assert part["rms"] == pytest.approx(np.sqrt((0.11**2 + 0.09**2) / 4.0), abs=1e-4)
    assert figures["both_ego"] == {"frames": 10, "both": 10, "share": 1.0}


def test_a_boundary_in_the_wrong_role_is_followed_but_not_in_its_role() -> None:
    figures = error_figures([run(10, lambda _: (EGO[0], Reported(2, 0.5, 2)))])
    assert figures["followed"]["share"] == 1.0
    assert figures["both_ego"]["share"] == 0.0


# Gaps


def gap_run(length: int, answer: Callable[[int], tuple[Reported, ...]]) -> ClipRun:
    """Returns a clip in which boundary 1 is hidden for `length` frames from frame 10 on."""

    def truth(n: int) -> tuple[TrueLane, ...]:
        hidden = 10 <= n < 10 + length
        return (TrueLane(1, -0.5, n - 9 if hidden else 0, length if hidden else 0), PAIR[1])

    return run(length + 40, answer, truth)


def test_a_gap_that_a_track_survives() -> None:
    def drifting(n: int) -> tuple[Reported, ...]:
        error = 0.004 * (n - 9) if 10 <= n < 20 else 0.0
        return (Reported(1, -0.5 + error, state="predicted" if error else "detected"), EGO[1])

    figures = gap_figures([gap_run(10, drifting)])
    gap = figures["10"]
    assert (gap["gaps"], gap["same_id"], gap["held_to_end"], gap["small_errors"]) == (1, 1, 1, 1)
    assert gap["median_end_error"] == pytest.approx(0.04, abs=1e-4)
    assert all(figures[other]["gaps"] == 0 for other in figures if other != "10")


def test_a_large_error_at_the_end_of_a_gap() -> None:
    gap = gap_figures([gap_run(10, lambda n: (Reported(1, -0.5 + (0.06 if n == 19 else 0.0)), EGO[1]))])["10"]
    assert (gap["same_id"], gap["held_to_end"], gap["small_errors"]) == (1, 1, 0)
    # The limit of longer gaps is wider.
    longer = gap_figures([gap_run(30, lambda n: (Reported(1, -0.5 + (0.06 if n == 39 else 0.0)), EGO[1]))])["30"]
    assert (longer["small_errors"], longer["error_limit"]) == (1, 0.1)


def test_an_id_that_is_lost_in_a_gap() -> None:
    def lost(n: int) -> tuple[Reported, ...]:
        return (EGO[1],) if 15 <= n < 31 else (Reported(1 if n < 15 else 8, -0.5), EGO[1])

    gap = gap_figures([gap_run(20, lost)])["20"]
    assert (gap["gaps"], gap["same_id"], gap["held_to_end"], gap["small_error_share"]) == (1, 0, 0, 0.0)


def test_another_track_at_the_end_of_a_gap_does_not_hold_it() -> None:
    gap = gap_figures([gap_run(20, lambda n: (Reported(1 if n < 25 else 8, -0.5), EGO[1]))])["20"]
    assert (gap["same_id"], gap["held_to_end"], gap["small_errors"]) == (0, 0, 0)


def test_a_boundary_that_was_not_followed_before_its_gap_does_not_count() -> None:
    assert gap_figures([gap_run(10, lambda n: EGO if n >= 10 else (EGO[1],))])["10"]["gaps"] == 0


# Ghosts


def test_a_track_that_follows_nothing_in_most_of_its_frames_is_a_ghost() -> None:
    def answer(n: int) -> tuple[Reported, ...]:
        wanders = Reported(9, 0.0 if n < 6 else -0.5, -2)
        return (EGO[1], wanders) if n < 10 else EGO[1:]

    figures = ghost_figures([run(50, answer)])
    assert (figures["tracks"], figures["ghosts"], figures["ghost_frames"]) == (2, 1, 6)
    assert figures["minutes"] == pytest.approx(2.0 / 60.0, abs=1e-4)
    assert figures["ghosts_per_minute"] == pytest.approx(30.0)


def test_a_duplicate_of_a_followed_boundary_is_no_ghost() -> None:
    assert ghost_figures([run(10, lambda _: (*EGO, Reported(3, 0.6, 2)))])["ghosts"] == 0


# Edges of the road: a kerb 0.4 lane widths beside the ego lane


KERB = TrueLane(3, 0.9, type="kerb")


def with_kerb(_: int) -> tuple[TrueLane, ...]:
    return (*PAIR, KERB)


@pytest.mark.parametrize("place", [0.9, 1.3])
def test_a_reported_edge_on_an_edge_or_beyond_the_markings_is_ignored(place: float) -> None:
    answers = run(10, lambda _: (*EGO, Reported(3, place, 2, kind="road_edge")), with_kerb)
    perfect = run(10, lambda _: EGO, with_kerb)
    for figures in (identity_figures, ghost_figures, error_figures):
        assert figures([answers]) == figures([perfect])
    assert identity_figures([answers])["boundaries"] == 2


def test_a_marking_on_an_edge_is_a_ghost_and_an_edge_between_the_markings_is_not() -> None:
    on_kerb = run(10, lambda _: (*EGO, Reported(3, 0.9, 2)), with_kerb)
    assert (ghost_figures([on_kerb])["ghosts"], ghost_figures([on_kerb])["ghost_frames"]) == (1, 10)
    between = run(10, lambda _: (*EGO, Reported(3, 0.0, -2, kind="road_edge")), with_kerb)
    assert ghost_figures([between])["ghosts"] == 0
    assert identity_figures([between])["id_false_positives"] == 10


def test_a_marking_that_is_reported_as_an_edge_is_still_followed() -> None:
    figures = error_figures([run(10, lambda _: (EGO[0], Reported(2, 0.5, kind="road_edge")), with_kerb)])
    assert figures["followed"] == {"ego_boundaries": 20, "followed": 20, "share": 1.0}


# Kind, type and color


def test_types_and_colors_count_from_two_seconds_of_a_track_on() -> None:
    """The right track learns its type after 2.4 s; its color is wrong throughout."""

    def answer(n: int) -> tuple[Reported, ...]:
        learned = "solid" if n >= 60 else "dashed"
        return (Reported(1, -0.5, type="solid"), Reported(2, 0.5, type=learned, color="yellow"))

    figures = appearance_figures([run(100, answer)])
    assert figures["kind"] == {
        "values": 100, "right": 100, "share": 1.0, "tracks": 2, "right_tracks": 2, "track_share": 1.0
    }  # fmt: skip
    assert (figures["type"]["values"], figures["type"]["right"], figures["type"]["right_tracks"]) == (100, 90, 2)
    assert (figures["color"]["right"], figures["color"]["right_tracks"]) == (50, 1)
    assert appearance_figures([run(100, answer)], after_s=0.0)["type"]["values"] == 200


def test_an_edge_and_a_track_without_a_type_are_not_right() -> None:
    answers = run(60, lambda _: (Reported(1, -0.5), Reported(2, 0.5, kind="road_edge")))
    figures = appearance_figures([answers])
    assert (figures["kind"]["share"], figures["type"]["share"], figures["type"]["track_share"]) == (0.5, 0.0, 0.0)
    assert appearance_figures([])["type"]["share"] is None


# Cuts


def cut_run(answer: Callable[[int], tuple[Reported, ...]], cut_event: int | None = None) -> ClipRun:
    """Returns a clip with a cut at frame 10 to a road whose boundaries are elsewhere and have new ids."""
    after = (TrueLane(11, -0.3), TrueLane(12, 0.7))
    return run(
        30,
        answer,
        lambda n: PAIR if n < 10 else after,
        lambda n: {"scene": int(n >= 10)},
        lambda n: {"events": [{"type": "scene_cut", "timestamp": n / FPS}] if n == cut_event else []},
    )


def test_a_clean_cut() -> None:
    new = (Reported(5, -0.3), Reported(6, 0.7))
    figures = cut_figures([cut_run(lambda n: EGO if n < 10 else new, cut_event=10)])
    assert (figures["cuts"], figures["old_id_boundaries"], figures["ghost_boundaries"]) == (1, 0, 0)
    assert (figures["found_ego"], figures["most_frames_to_ego"]) == (1, 0)
    assert (figures["events"], figures["false_events"]) == (1, 0)


def test_what_is_left_of_the_old_scene_after_a_cut() -> None:
    def answer(n: int) -> tuple[Reported, ...]:
        new = (Reported(5, -0.3), Reported(6, 0.7))
        if n < 10:
            return EGO
        return (Reported(1, 0.15, -2), *(new if n >= 13 else ())) if n < 15 else new

    figures = cut_figures([cut_run(answer, cut_event=20)])
    assert (figures["old_id_boundaries"], figures["ghost_boundaries"]) == (5, 5)
    assert figures["most_frames_to_ego"] == 3
    assert figures["false_events"] == 1


# Jumps


def test_a_jump_is_a_step_that_the_truth_does_not_make() -> None:
    figures = jump_figures([run(11, lambda n: (Reported(1, -0.5 + (0.15 if n == 5 else 0.0)), EGO[1]))])
    assert figures["bottom"] == {"steps": 20, "jumps": 2, "jump_share": 0.1}
    moving = jump_figures(
        [run(5, lambda n: (Reported(1, -0.5 + 0.12 * n),), lambda n: (TrueLane(1, -0.5 + 0.12 * n),))]
    )
    assert moving["bottom"]["jumps"] == 0


# Uncertainty


def noisy_run(error: float, sigma: float, state: str = "detected", frames: int = 1500) -> ClipRun:
    errors = np.random.default_rng(7).normal(0.0, error, frames)
    return run(frames, lambda n: (Reported(1, -0.5 + float(errors[n]), state=state, sigma=sigma),))


def test_errors_of_the_reported_size_are_covered_by_the_band() -> None:
    figures = uncertainty_figures([noisy_run(0.03, 0.03)])
    for row in ("bottom", "far"):
        coverage = figures["detected"]["coverage"][row]
        assert coverage["values"] == 1500
        assert coverage["share"] == pytest.approx(0.95, abs=0.02)
    # All rows have one and the same error, so a third of the degrees of freedom has it.
    assert figures["all"]["nees_per_dof"] == pytest.approx(1.0 / 3.0, abs=0.05)
    assert figures["inferred"]["boundaries"] == figures["predicted"]["boundaries"] == 0


def test_a_sigma_of_half_the_error_covers_two_thirds() -> None:
    figures = uncertainty_figures([noisy_run(0.04, 0.02, "predicted")])
    assert figures["predicted"]["coverage"]["bottom"]["share"] == pytest.approx(0.673, abs=0.03)
    assert figures["all"]["nees_per_dof"] == pytest.approx(4.0 / 3.0, rel=0.1)
    assert figures["detected"]["boundaries"] == 0


def test_nis_is_the_mean_over_updates() -> None:
    def nis(n: int) -> dict[str, Any]:
        return {"nis": [1.5, 0.5] if n else []}

    assert uncertainty_figures([run(5, lambda _: EGO, message_fields=nis)])["nis"] == {"updates": 8, "per_dof": 1.0}
    assert uncertainty_figures([run(5, lambda _: EGO)])["nis"] == {"updates": 0, "per_dof": None}


# Jitter and lag


def swaying(n: float) -> float:
    return 0.1 * float(np.sin(2.0 * np.pi * n / 60.0))


def test_the_lag_of_a_delayed_track_is_its_delay() -> None:
    delayed = run(150, lambda n: (Reported(1, -0.4 + swaying(n - 1.5)),), lambda n: (TrueLane(1, -0.4 + swaying(n)),))
    figures = motion_figures([delayed])
    assert figures["lag"]["bottom"]["lag_frames"] == pytest.approx(1.5, abs=0.05)
    assert figures["lag"]["far"]["lag_frames"] == pytest.approx(1.5, abs=0.05)
    assert figures["lag"]["bottom"]["frames"] == 150


def test_a_constant_bias_is_not_lag() -> None:
    biased = run(150, lambda n: (Reported(1, -0.37 + swaying(n)),), lambda n: (TrueLane(1, -0.4 + swaying(n)),))
    assert motion_figures([biased])["lag"]["bottom"]["lag_frames"] == pytest.approx(0.0, abs=1e-6)


def test_noise_of_the_reference_does_not_look_like_lag() -> None:
    times = np.arange(2000.0)
    x = 300.0 + 40.0 * np.sin(times / 12.0)
    noisy = x + np.random.default_rng(3).normal(0.0, 2.0, len(x))
    delayed = 300.0 + 40.0 * np.sin((times - 0.8) / 12.0)
    assert lag([(delayed, noisy)])["lag_frames"] == pytest.approx(0.8, abs=0.1)
    assert lag([(x[:20], x[:20])]) == {"frames": 0, "lag_frames": None}


def test_jitter_is_the_second_difference_of_the_ego_boundaries() -> None:
    figures = motion_figures([run(41, lambda n: (Reported(1, -0.5 + 0.01 * (n % 2)),))])["jitter"]
    rows = np.array([0.7, 0.8, 0.9]) * 360.0 - 160.0
    expected = 0.02 * 2.5 * rows
    assert figures["samples"] == 39 * 3
    assert figures["rms_px_640"] == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-3)
    assert figures["mad_px_640"] == pytest.approx(1.4826 * np.median(expected), rel=1e-3)
    assert motion_figures([run(41, lambda n: (Reported(1, -0.5 + 0.001 * n),))])["jitter"]["rms_px_640"] < 1e-6


# Meters and departures


def test_errors_in_meters_have_a_bias_and_an_rms() -> None:
    def ego(n: int) -> dict[str, Any]:
        offset = 0.05 if n % 2 else -0.03
        values = {"offset_m": offset, "lane_width_m": LANE_WIDTH + 0.1, "heading": 0.01, "curvature": 0.001}
        return {"ego": {"left": 1, "right": 2, **values}}

    figures = meter_figures([run(10, lambda _: EGO, message_fields=ego)])
    assert figures["offset_cm"] == {"values": 10, "rms": pytest.approx(np.sqrt(17.0), abs=1e-4), "bias": 1.0}
    assert figures["lane_width_cm"]["bias"] == pytest.approx(10.0)
    assert figures["heading_deg"]["rms"] == pytest.approx(np.degrees(0.01), abs=1e-4)
    assert figures["curvature_per_m"]["rms"] == pytest.approx(0.001)


def test_an_offset_in_another_lane_is_not_compared() -> None:
    def ego(_: int) -> dict[str, Any]:
        return {"ego": {"left": 2, "right": 3, "offset_m": 2.0, "lane_width_m": 3.5, "heading": 0.0, "curvature": 0.0}}

    figures = meter_figures([run(10, lambda _: EGO, message_fields=ego)])
    assert (figures["offset_cm"]["values"], figures["heading_deg"]["values"]) == (0, 10)


def test_the_calibration_counts_after_twenty_seconds() -> None:
    def calibration(n: int) -> dict[str, Any]:
        return {"calibration": {"pitch": 1.3 if n >= 500 else 9.0, "yaw": -0.5, "settled": n >= 500}}

    truth = {"truth_pitch": 1.0, "truth_yaw": 0.0}
    figures = calibration_figures([run(525, lambda _: EGO, record_fields=lambda _: truth, message_fields=calibration)])
    assert figures["pitch_deg"] == {"values": 25, "rms": 0.3, "bias": 0.3}
    assert figures["yaw_deg"]["bias"] == -0.5


def drift(warned: range, side: str = "left", offset: Callable[[int], float] | None = None) -> Mapping[str, Any]:
    """Returns the departure figures of a drift to the left at 0.25 m/s, whose wheel reaches the line at frame 85."""

    def ego(n: int) -> dict[str, Any]:
        drifted = -0.01 * n if offset is None else offset(n)
        return {"ego": {"offset_m": drifted, "lane_width_m": LANE_WIDTH}}

    def departure(n: int) -> dict[str, Any]:
        warns = n in warned
        return {"departure": {"state": "warning" if warns else "none", "side": side if warns else None}}

    return departure_figures([run(150, lambda _: EGO, record_fields=ego, message_fields=departure)])


def test_a_warning_before_the_wheel_is_far_beyond_the_line_is_right() -> None:
    figures = drift(range(75, 150))
    assert (figures["crossings"], figures["warned"], figures["warnings"], figures["false_warnings"]) == (1, 1, 1, 0)
    assert figures["median_lead_s"] == pytest.approx(11.0 / FPS, abs=1e-4)


@pytest.mark.parametrize(("first", "warned"), [(114, 1), (118, 0)])
def test_a_warning_after_that_is_too_late(first: int, warned: int) -> None:
    figures = drift(range(first, 150))
    assert (figures["warned"], figures["missed"]) == (warned, 1 - warned)


def test_a_warning_on_the_other_side_is_false_and_the_crossing_missed() -> None:
    figures = drift(range(75, 150), side="right")
    assert (figures["missed"], figures["false_warnings"]) == (1, 1)


def test_a_warning_in_the_middle_of_the_lane_is_false() -> None:
    figures = drift(range(20, 30), offset=lambda _: 0.0)
    assert (figures["crossings"], figures["warnings"], figures["false_warnings"]) == (0, 1, 1)


@pytest.mark.parametrize(("closest", "false"), [(0.25, 0), (0.35, 1)])
def test_a_warning_is_false_if_the_wheel_stays_well_inside(closest: float, false: int) -> None:
    """The wheel is 0.85 m inside in the middle of the lane."""
    figures = drift(range(60, 70), offset=lambda n: -min(0.01 * n, 0.85 - closest))
    assert (figures["crossings"], figures["warnings"], figures["false_warnings"]) == (0, 1, false)


def test_a_lane_change_is_one_crossing() -> None:
    """The offset jumps by a lane when the vehicle's middle crosses the boundary."""

    def offset(n: int) -> float:
        return -0.02 * n if n < 88 else -0.02 * n + LANE_WIDTH

    assert drift(range(30, 150), offset=offset)["crossings"] == 1


def test_figures_are_json_without_nan() -> None:
    groups = (identity_figures, role_figures, event_figures, error_figures, lane_change_figures, gap_figures)
    more = (ghost_figures, cut_figures, jump_figures, uncertainty_figures, motion_figures, meter_figures)
    for figures in (*groups, *more, calibration_figures, departure_figures, appearance_figures):
        for runs in ([], [run(3, lambda _: ())]):
            json.dumps(figures(runs), allow_nan=False)
