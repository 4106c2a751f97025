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
from lanestream.road.curve import FloatArray
from lanestream.road.view import Image
from lanestream_client.colors import ALERT, CAUTION, WHITE, position_color
from lanestream_client.drawing import Drawing
from lanestream_client.labels import draw_legend
from lanestream_client.line_styles import line_name, line_style
from lanestream_client.overlays import draw_error, draw_lanes
from lanestream_client.road_panel import draw_road_panel, panel_width


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


def test_the_legend_has_the_latency_if_it_is_known() -> None:
    image, message = road(1280, 720)
    timed = message.model_copy(update={"timing_ms": message.timing_ms.model_copy(update={"total": 12.3})})
    titles = [draw_lanes(image, each)[13:45, 13:300] for each in (message, timed)]
    assert with_color(titles[0], WHITE) < 0.7 * with_color(titles[1], WHITE)


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


SIZES = [(320, 180), (640, 360), (640, 640), (1280, 720), (3840, 2160)]


def green(drawn: Image) -> FloatArray:
    """Returns how much greener than red each pixel is, which on a gray road is the opacity of the ego lane."""
    return drawn[..., 1].astype(float) - drawn[..., 2]


def test_the_ego_lane_fades_with_distance_and_toward_the_vehicle() -> None:
    image, message = road(1280, 720)
    opacity = green(draw_lanes(image, message))[:, 640]
    assert opacity[560] > opacity[450] > opacity[380] > 0.0
    assert opacity[370] < 0.25 * opacity[560], "the far end is nearly invisible"
    assert opacity[560] > opacity[690] > opacity[717] >= 0.0
    assert opacity[717] < 0.2 * opacity[560]
    assert np.abs(np.diff(opacity[362:718])).max() < 5.0, "no edge runs across the lane"
    assert (opacity[:358] == 0.0).all()


def test_the_ego_lane_starts_at_the_lowest_points() -> None:
    image, message = road(1280, 720)
    lanes = []
    for lane, bottom in zip(message.lanes, (600.0, 560.0), strict=True):
        line = LineModel(bottom=(lane.x(bottom), bottom), top=lane.line.top)
        lanes.append(lane.model_copy(update={"line": line}))
    opacity = green(draw_lanes(image, message.model_copy(update={"lanes": lanes})))
    assert opacity[500, 640] > 10.0
    assert (opacity[602:, 640] == 0.0).all(), "nothing below, where the vehicle's hood may be"


def test_the_ego_lane_goes_on_beside_a_boundary_that_leaves_the_image() -> None:
    image, message = road(1280, 720)
    left = message.lanes[0]
    # It reaches the left side of the image at row 538 of 720.
    curve = (640.0, -2.56, 0.0)
    ends = [(curve[0] + curve[1] * (row - left.horizon), row) for row in (535.0, 360.0)]
    oblique = left.model_copy(
        update={"coefficients": curve, "points": ends, "line": LineModel(bottom=ends[0], top=ends[1])}
    )
    opacity = green(draw_lanes(image, message.model_copy(update={"lanes": [oblique, message.lanes[1]]})))
    assert opacity[560, 5] > 10.0
    assert np.abs(np.diff(opacity[500:718, 300])).max() < 5.0


@pytest.mark.parametrize("state", ["detected", "inferred", "predicted"])
def test_lines_fade_with_distance(state: str) -> None:
    image, message = road(1280, 720)
    drawn = alone(image, message, state=state, **painted("white", "double"))
    strength = np.ptp(drawn.astype(int), axis=2).max(axis=1)  # how colorful the rows from 360 to 720 are
    assert strength[2:20].max() < 0.75 * strength[200:].max()


def test_boundaries_that_are_barely_probable_are_faint() -> None:
    image, message = road(1280, 720)
    strength = [
        int(np.ptp(alone(image, message, probability=probability, position=2)[:150].astype(int), axis=2).max())
        for probability in (0.3, 0.6, 0.95)
    ]
    assert 10 < strength[0] < 0.6 * strength[2]
    assert strength[0] < strength[1] < strength[2]


def test_predicted_lines_fade_more_than_detected_ones() -> None:
    _, message = road(320, 180)
    detected, predicted = (
        line_style(message.lanes[0].model_copy(update={"state": s})) for s in ("detected", "predicted")
    )
    assert predicted.far_opacity / predicted.near_opacity < detected.far_opacity / detected.near_opacity
    assert len(predicted.pieces) > len(detected.pieces) == 1


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_text_is_inside_the_image_and_nothing_overlaps(width: int, height: int) -> None:
    image, message = road(width, height)
    message = in_meters(message, 0.3, DepartureModel(), 0.01)
    outer = [
        lane.model_copy(update={"track_id": 3 + number, "position": 2 * lane.position, **painted("yellow", "dashed")})
        for number, lane in enumerate(message.lanes)
    ]
    message = message.model_copy(update={"lanes": [*message.lanes, *outer]})
    drawing = Drawing.on_copy_of(image)
    legend = draw_legend(drawing, message, width - panel_width(drawing, message))
    assert legend is not None
    boxes = [legend, *draw_road_panel(drawing, message)]
    assert len(boxes) == (2 if width == 320 else 3), "the map has no room on small images"
    for left, top, right, bottom in boxes:
        assert 0.0 <= left < right <= width
        assert 0.0 <= top < bottom <= 0.5 * height
    for number, (_, _, right, _) in enumerate(sorted(boxes)[:-1]):
        assert right < sorted(boxes)[number + 1][0]


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_letters_are_at_least_seven_pixels_high(width: int, height: int) -> None:
    drawing = Drawing.on_copy_of(np.zeros((height, width, 3), np.uint8))
    drawing.text("H", (20.0, 100.0), WHITE, 0.5)
    rows = np.nonzero((drawing.image > 100).any(axis=(1, 2)))[0]
    assert 7 <= np.ptp(rows) + 1 <= 0.06 * height


def test_text_is_clipped_at_the_edges_of_the_image() -> None:
    inside = [(-30.0, 20.0), (300.0, 20.0), (20.0, 3.0), (20.0, 184.0)]
    outside = [(20.0, -20.0), (20.0, 220.0), (900.0, 20.0), (-900.0, 900.0)]
    for at in (*inside, *outside):
        drawing = Drawing.on_copy_of(np.zeros((180, 320, 3), np.uint8))
        drawing.text("frame 17", at, WHITE)
        assert drawing.image.any() == (at in inside)


def test_labels_do_not_hide_each_other() -> None:
    image, message = road(640, 360)
    lane = message.lanes[0]
    several = [lane.model_copy(update={"track_id": number, "position": -number}) for number in (1, 2, 3)]
    alone_drawn = draw_lanes(image, message.model_copy(update={"lanes": several[:1]}))
    drawn = draw_lanes(image, message.model_copy(update={"lanes": several}))
    row = round(0.7 * lane.line.bottom[1] + 0.3 * lane.line.top[1])
    label = (slice(row - 6, row + 6), slice(round(lane.x(row)) - 6, round(lane.x(row)) + 6))
    assert (drawn[label] == alone_drawn[label]).all(), "the label of the ego boundary is in its place, on top"


def test_no_lanes_and_unknown_positions_can_be_drawn() -> None:
    image, message = road(320, 180)
    assert draw_lanes(image, message.model_copy(update={"lanes": []})).shape == image.shape
    outer = message.lanes[0].model_copy(update={"position": 5})
    assert draw_lanes(image, message.model_copy(update={"lanes": [outer]})).shape == image.shape


def test_an_error_can_be_drawn() -> None:
    image = np.full((180, 320, 3), 90, np.uint8)
    assert (draw_error(image, error_message(SourceError("why"), seq=3)) != image).any()


def test_a_long_error_is_written_on_several_lines() -> None:
    image = np.full((180, 320, 3), 90, np.uint8)
    short, long = (draw_error(image, error_message(SourceError(text), seq=3)) for text in ("why", "why " * 30))
    changed = [np.nonzero((drawn != image).any(axis=(1, 2)))[0].max() for drawn in (short, long)]
    assert changed[1] > changed[0] + 20
    assert (long[:, 312:] == 90).all(), "no line reaches the edge"
