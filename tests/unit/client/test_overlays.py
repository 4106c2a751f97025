"""Drawing lanes and errors on images."""

from __future__ import annotations

import fakes
import numpy as np
import pytest

from lanestream.errors import SourceError
from lanestream.protocol import (
    DepartureModel,
    EgoModel,
    LaneModel,
    LanesMessage,
    LineModel,
    MarkingColor,
    MarkingModel,
    MarkingType,
    error_message,
)
from lanestream.road.view import Image
from lanestream_client.colors import ALERT, CAUTION, WHITE, position_color
from lanestream_client.line_styles import line_name
from lanestream_client.overlays import draw_error, draw_lanes


def road(width: int, height: int) -> tuple[Image, LanesMessage]:
    """Returns a gray image, and a straight lane whose middle is the image's."""
    horizon, top, bottom = 0.4 * height, 0.5 * height, height - 1.0
    lanes = []
    for track_id, position in ((1, -1), (2, 1)):
        curve = (width / 2.0, 0.3 * position * width / (height - horizon), 0.0)
        ends = [(curve[0] + curve[1] * (row - horizon), row) for row in (bottom, top)]
        lane = LaneModel(
            track_id=track_id,
            position=position,
            state="detected",
            probability=0.9,
            points=ends,
            line=LineModel(bottom=ends[0], top=ends[1]),
            horizon=horizon,
            coefficients=curve,
            covariance=np.eye(3).tolist(),
            age_s=1.0,
        )
        lanes.append(lane)
    ego = EgoModel(left=1, right=2, offset=0.0)
    update = {"width": width, "height": height, "horizon": horizon, "lanes": lanes, "ego": ego}
    return np.full((height, width, 3), 90, np.uint8), fakes.lanes(7).model_copy(update=update)


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (320, 180), (64, 64), (3840, 2160), (181, 101)])
def test_lanes_are_drawn_at_any_size(width: int, height: int) -> None:
    image, message = road(width, height)
    drawn = draw_lanes(image, message)
    assert drawn.shape == image.shape
    assert drawn.dtype == np.uint8
    assert (image == 90).all(), "the original is unchanged"
    left, right = message.lanes
    row = round(0.8 * height)
    blue, _, red = (int(value) for value in drawn[row, round(left.x(row))])
    assert red > blue, "the left boundary is orange"
    blue, _, red = (int(value) for value in drawn[row, round(right.x(row))])
    assert blue > red, "the right boundary is blue"
    middle = drawn[row, width // 2]
    assert middle[1] > middle[2], "the ego lane is green"


def test_boundaries_without_a_detection_are_dashed() -> None:
    image, message = road(1280, 720)

    def drawn_pixels(state: str) -> int:
        lane = message.lanes[0].model_copy(update={"state": state, "position": -2})
        drawn = draw_lanes(image, message.model_copy(update={"lanes": [lane]}))
        return int((drawn[360:] != 90).any(axis=2).sum())

    predicted, inferred, detected = (drawn_pixels(state) for state in ("predicted", "inferred", "detected"))
    assert predicted < 0.75 * detected
    assert 1.1 * predicted < inferred < 0.95 * detected


def painted(color: MarkingColor, kind: MarkingType) -> dict[str, object]:
    """Returns the fields of a lane that is a marking of this type and color."""
    return {
        "kind": "marking",
        "marking": MarkingModel(type=kind, type_probability=0.9, color=color, color_probability=0.9, probability=0.8),
    }


def alone(image: Image, message: LanesMessage, **fields: object) -> Image:
    """Returns the road below the legend with only the right boundary, with these fields, on it."""
    lane = message.lanes[1].model_copy(update=fields)
    return draw_lanes(image, message.model_copy(update={"lanes": [lane]}))[360:]


def pieces(drawn: Image, lane: LaneModel, aside: float = 0.0) -> int:
    """Returns the number of pieces in which a boundary is drawn, along its curve or some pixels aside."""
    rows = np.arange(362, 718)
    columns = np.round([lane.x(float(row)) + aside for row in rows]).astype(int)
    on = (drawn[rows - 360, columns] != 90).any(axis=1)
    return int(on[0]) + int((np.diff(on.astype(int)) == 1).sum())


def test_the_shape_of_a_marking_is_its_type() -> None:
    image, message = road(1280, 720)
    lane = message.lanes[1]
    solid, dashed, dots, double = (
        alone(image, message, **painted("white", kind)) for kind in ("solid", "dashed", "dots", "double")
    )
    assert [pieces(drawn, lane) for drawn in (solid, dashed)] == [1, 7]
    assert pieces(dots, lane) > 14
    # The label hides the middle of the lower part, so the two lines are counted above it.
    across = slice(int(lane.x(430.0)) - 15, int(lane.x(430.0)) + 16)
    colored = [np.ptp(drawn[70, across].astype(int), axis=1) > 60 for drawn in (solid, double)]
    assert [int((np.diff(np.pad(on, 1).astype(int)) == 1).sum()) for on in colored] == [1, 2]


def test_a_yellow_marking_has_a_yellow_core() -> None:
    image, message = road(1280, 720)
    yellow = (0, 235, 255)
    drawn = {color: alone(image, message, **painted(color, "solid")) for color in ("white", "yellow")}
    assert with_color(drawn["yellow"], yellow) > 500
    assert with_color(drawn["white"], yellow) == 0
    blue = position_color(1)
    assert with_color(drawn["yellow"], blue) > 500, "its rims show the position"


@pytest.mark.parametrize(("position", "side"), [(-2, -1), (-1, -1), (1, 1), (2, 1)])
def test_a_road_edge_is_white_with_ticks_away_from_the_vehicle(position: int, side: int) -> None:
    image, message = road(1280, 720)
    lane = message.lanes[1]
    edge = alone(image, message, kind="road_edge", position=position)
    assert with_color(edge, WHITE) > 500
    rows = np.array([row for row in range(362, 718) if not 530 <= row < 660])  # the label is between
    columns = np.round([lane.x(float(row)) for row in rows]).astype(int)
    ticks = [with_color(edge[rows - 360, columns + sign * 20][None], WHITE) for sign in (side, -side)]
    assert ticks[0] > 5
    assert ticks[1] == 0


@pytest.mark.parametrize("fields", [{"kind": "road_edge"}, painted("white", "dashed"), painted("yellow", "double")])
def test_a_predicted_boundary_is_paler_whatever_it_is(fields: dict[str, object]) -> None:
    image, message = road(1280, 720)
    brightest = [
        int(alone(image, message, state=state, **fields)[:150].max()) for state in ("predicted", "inferred", "detected")
    ]
    assert brightest[0] + 30 < brightest[1] + 15 < brightest[2]


def test_the_legend_says_what_boundaries_are() -> None:
    _, message = road(320, 180)
    marking, edge = message.lanes
    assert line_name(marking) == ""
    assert line_name(marking.model_copy(update=painted("yellow", "double"))) == "double yellow"
    assert line_name(edge.model_copy(update={"kind": "road_edge"})) == "road edge"


@pytest.mark.parametrize("kind", ["solid", "dashed", "double", "dots"])
def test_the_map_shows_what_boundaries_are(kind: MarkingType) -> None:
    image, message = road(1280, 720)
    known = in_meters(message, 0.0, DepartureModel(), 1e-6)

    def map_of(**fields: object) -> Image:
        lanes = [lane.model_copy(update=fields) for lane in known.lanes]
        return draw_lanes(image, known.model_copy(update={"lanes": lanes}))[13:242, 1118:1267]

    white, yellow, edge = map_of(**painted("white", kind)), map_of(**painted("yellow", kind)), map_of(kind="road_edge")
    assert (white != yellow).any()
    assert (white != edge).any()
    assert (white != map_of()).any() == (kind != "solid")


def in_meters(message: LanesMessage, offset_m: float, departure: DepartureModel, variance: float) -> LanesMessage:
    """Returns `message` as if the camera were known; the boundaries' distances have this variance."""
    lanes = [
        lane.model_copy(
            update={
                "ground": (0.001, 0.0, side * 1.8 + offset_m),
                "ground_covariance": np.diag([0, 0, variance]).tolist(),
            }
        )
        for lane, side in zip(message.lanes, (1.0, -1.0), strict=True)
    ]
    ego = message.ego.model_copy(update={"offset": offset_m / 3.6, "offset_m": offset_m, "lane_width_m": 3.6})
    return message.model_copy(update={"lanes": lanes, "ego": ego, "departure": departure})


def with_color(image: Image, color: tuple[int, int, int]) -> int:
    return int((np.abs(image.astype(int) - color).max(axis=2) < 30).sum())


@pytest.mark.parametrize(("width", "height"), [(1280, 720), (320, 180), (64, 64), (3840, 2160), (181, 101)])
def test_meters_are_drawn_at_any_size(width: int, height: int) -> None:
    image, message = road(width, height)
    drawn = draw_lanes(image, in_meters(message, 0.3, DepartureModel(state="none"), 0.01))
    assert drawn.shape == image.shape


def test_a_departure_is_shown_in_its_color() -> None:
    image, message = road(1280, 720)

    def panel(departure: DepartureModel) -> Image:
        return draw_lanes(image, in_meters(message, 1.2, departure, 0.01))[:200, 640:1100]

    none = panel(DepartureModel(state="none"))
    warning = panel(DepartureModel(state="warning", side="right", time_to_crossing=0.7))
    crossed = panel(DepartureModel(state="crossed", side="right", time_to_crossing=0.0))
    assert with_color(none, CAUTION) == with_color(none, ALERT) == 0
    assert with_color(warning, CAUTION) > 200
    assert with_color(crossed, ALERT) > 200


def test_the_offset_bar_shows_the_side() -> None:
    image, message = road(1280, 720)
    columns = []
    for offset_m in (-1.0, 0.0, 1.0):
        bar = draw_lanes(image, in_meters(message, offset_m, DepartureModel(), 0.01))[16:46, 840:1105]
        columns.append(float(np.nonzero((bar > 200).all(axis=2))[1].mean()))
    assert np.diff(columns) == pytest.approx([57.0, 57.0], abs=2.0)


def test_the_map_shows_the_road_and_its_uncertainty() -> None:
    image, message = road(1280, 720)

    def colored(variance: float) -> int:
        part = draw_lanes(image, in_meters(message, 0.0, DepartureModel(), variance))[13:242, 1118:1267]
        return int((np.ptp(part.astype(int), axis=2) > 30).sum())

    assert 0 < colored(1e-6) < 0.5 * colored(0.25)
    without = draw_lanes(image, message)[80:242, 1118:1267]
    assert (without == 90).all()


def test_no_lanes_and_unknown_positions_can_be_drawn() -> None:
    image, message = road(320, 180)
    assert draw_lanes(image, message.model_copy(update={"lanes": []})).shape == image.shape
    outer = message.lanes[0].model_copy(update={"position": 5})
    assert draw_lanes(image, message.model_copy(update={"lanes": [outer]})).shape == image.shape


def test_an_error_can_be_drawn() -> None:
    image = np.full((180, 320, 3), 90, np.uint8)
    assert (draw_error(image, error_message(SourceError("why"), seq=3)) != image).any()
