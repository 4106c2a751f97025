"""Looks of boundaries, fields of records, and what the manifest says about them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from labelfiles import (
    HEIGHT,
    LEFT,
    RIGHT,
    WIDTH,
    Draw,
    check_dataset,
    clip_record,
    cvat_image,
    faults,
    labelme,
    line_strip,
    polyline,
    read,
    write_cvat,
    write_lines,
    write_manifest,
)

from lanestream.errors import LabelError, SettingsError
from lanestream_exporter.datasets.contact_sheet import ContactSheet
from lanestream_exporter.datasets.labels import PARTIAL, Coverage, LabeledFrame, LabeledLane
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.datasets.reading import without_boxes
from lanestream_exporter.datasets.splits import SPLITS


def record(number: int, lanes: list[dict[str, Any]] | None = None, **fields: Any) -> dict[str, Any]:
    """Returns the record of a still image `number`.jpg."""
    described = [{"points": LEFT, "position": -1, "type": "solid", "color": "white"}] if lanes is None else lanes
    return {"image": f"{number}.jpg", "width": WIDTH, "height": HEIGHT, "lanes": described, **fields}


def write_stills(folder: Path, draw: Draw, *records: dict[str, Any]) -> None:
    for written in records:
        draw(written["image"])
    write_lines(folder / "labels.jsonl", *records)


def opened(folder: Path, **keys: Any) -> DatasetCollection:
    spec = {"name": "roads", "path": "labels.jsonl", "split": "train", **keys}
    return DatasetCollection.open(write_manifest(folder / "datasets.toml", spec), folder)


def frames_of(folder: Path, **keys: Any) -> list[LabeledFrame]:
    return [frame for frame, _ in opened(folder, **keys).frames("train")]


def looks(*lanes: LabeledLane) -> list[tuple[str | None, str | None, str | None]]:
    return [(lane.type, lane.color, lane.kind) for lane in lanes]


@pytest.mark.parametrize(
    ("type_name", "color", "expected"),
    [
        ("solid", "white", ("solid", "white", "marking")),
        ("double", "yellow", ("double", "yellow", "marking")),
        ("botts", "white", ("dots", "white", "marking")),
        ("dots", None, ("dots", None, "marking")),
        ("dashed", "unknown", ("dashed", None, "marking")),
        ("dashed", "blue", ("dashed", None, "marking")),
        ("unknown", "yellow", (None, "yellow", "marking")),
        ("unknown", "blue", (None, None, "marking")),
        ("unknown", "unknown", (None, None, None)),
        (None, None, (None, None, None)),
        ("kerb", "none", ("kerb", None, "road_edge")),
        ("curb", None, ("kerb", None, "road_edge")),
        ("edge", None, ("edge", None, "road_edge")),
        ("kerb", "white", ("kerb", None, "road_edge")),
        ("unknown", "none", ("edge", None, "road_edge")),
        ("edge", "unknown", (None, None, None)),
    ],
)
def test_clip_labels_name_type_and_color(
    tmp_path: Path, draw: Draw, type_name: str | None, color: str | None, expected: tuple[str | None, ...]
) -> None:
    write_stills(tmp_path, draw, record(1, [{"points": LEFT, "type": type_name, "color": color}]))
    assert looks(*read(tmp_path)[0].lanes) == [expected]


def test_an_unknown_type_is_reported(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, record(1, [{"points": LEFT, "type": "wavy"}]))
    (fault,) = faults(tmp_path)
    assert "labels.jsonl:1: its type 'wavy' is not known; accepted are solid, dashed, double, dots, kerb, edge" in fault


def test_labelme_and_cvat_name_kerbs_edges_and_dots(tmp_path: Path, draw: Draw) -> None:
    draw("me/a.jpg")
    draw("cvat/images/a.png")
    labelme(tmp_path / "me/a.json", "a.jpg", line_strip(LEFT, "left curb"), line_strip(RIGHT, "botts dots blue"))
    attribute = '<attribute name="type">kerb</attribute>'
    shapes = polyline(LEFT, attribute), polyline(RIGHT, label="road_edge"), polyline(RIGHT, label="red double")
    write_cvat(tmp_path / "cvat/annotations.xml", cvat_image("a.png", *shapes))
    kerb = ("kerb", None, "road_edge")
    assert looks(*read(tmp_path / "me")[0].lanes) == [kerb, ("dots", None, "marking")]
    assert looks(*read(tmp_path / "cvat")[0].lanes) == [
        kerb,
        ("edge", None, "road_edge"),
        ("double", None, "marking"),
    ]


def test_the_manifest_says_what_labels_without_a_look_are(tmp_path: Path, draw: Draw) -> None:
    lanes = [{"points": LEFT}, {"points": RIGHT, "type": "kerb"}]
    write_stills(tmp_path, draw, record(1, lanes))
    assert [lane.kind for lane in frames_of(tmp_path)[0].lanes] == [None, "road_edge"]
    assert [lane.kind for lane in frames_of(tmp_path, default_kind="marking")[0].lanes] == ["marking", "road_edge"]


def test_colors_of_some_records_are_ignored(tmp_path: Path, draw: Draw) -> None:
    painted = [{"points": LEFT, "type": "solid", "color": "yellow"}, {"points": RIGHT, "color": "white"}]
    write_stills(tmp_path, draw, record(1, painted, road="A"), record(2, painted, road="B"), record(3, painted))
    faded, *others = frames_of(tmp_path, ignore_colors={"road": ["A", "C"]})
    assert looks(*faded.lanes) == [("solid", None, "marking"), (None, None, "marking")]
    for frame in others:
        assert looks(*frame.lanes) == [("solid", "yellow", "marking"), (None, "white", "marking")]


def test_a_record_may_cover_less_than_its_data_set(tmp_path: Path, draw: Draw) -> None:
    fields: list[dict[str, Any]] = [{}, {"complete": True}, {"complete": False}, {"markings": False}]
    write_stills(tmp_path, draw, *(record(number, **given) for number, given in enumerate(fields)))
    covered = {"ego": True, "edges": True}
    whole = Coverage(**covered)
    expected = [whole, whole, PARTIAL, Coverage(**covered, markings=False)]
    assert [frame.coverage for frame in frames_of(tmp_path, coverage=covered)] == expected
    unpainted = frames_of(tmp_path, coverage={"edges": True, "markings": False})
    assert not any(frame.coverage.markings for frame in unpainted)
    assert [frame.coverage.markings for frame in read(tmp_path)] == [True, True, True, False]


def test_conditions_and_data_set_are_kept_with_a_frame(tmp_path: Path, draw: Draw) -> None:
    stated = {"scene": "street", "light": "dusk", "wet": True, "markings": False, "note": "a bus"}
    write_stills(tmp_path, draw, record(1, **stated), record(2, scene=4))
    first, second = frames_of(tmp_path)
    assert first.conditions == {"scene": "street", "light": "dusk", "wet": "yes", "markings": "no"}
    assert second.conditions == {}
    assert (first.dataset, read(tmp_path)[0].dataset) == ("roads", "")


def test_the_horizon_is_a_share_of_the_height(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, record(1, vanishing=-0.25), record(2, vanishing=0.5))
    above, inside = frames_of(tmp_path, horizon="vanishing")
    assert (above.horizon, inside.horizon) == (-0.25 * HEIGHT, 0.5 * HEIGHT)
    assert frames_of(tmp_path)[0].horizon is None
    working = above.at_working_width
    assert working.horizon is not None
    assert working.horizon / working.height == pytest.approx(-0.25, abs=0.01)


@pytest.mark.parametrize("value", [-0.7, 1.5, True, "half"])
def test_other_horizons_are_refused(tmp_path: Path, draw: Draw, value: object) -> None:
    write_stills(tmp_path, draw, record(1, horizon=value))
    with pytest.raises(LabelError, match=r"labels\.jsonl:1: its horizon .*a share of the height from -0\.6 to 1 is"):
        frames_of(tmp_path, horizon="horizon")


def test_a_field_of_the_record_is_the_drive(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, record(1, street="A"), record(2, street="B"), record(3, street="A"))
    assert [frame.group for frame in frames_of(tmp_path, group="street")] == ["A", "B", "A"]
    with pytest.raises(LabelError, match=r"labels\.jsonl:1: the record has no road .*names this field for 'roads'"):
        frames_of(tmp_path, group="road")


def test_named_drives_validate(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, *(record(number, street=street) for number, street in enumerate("ABCB")))
    datasets = opened(tmp_path, group="street", split={"by": "name", "val": ["B"]})
    found = {split: [frame.source for frame, _ in datasets.frames(split)] for split in SPLITS}
    assert found == {"train": ["0.jpg", "2.jpg"], "val": ["1.jpg", "3.jpg"], "test": []}
    with pytest.raises(LabelError, match=r"there is no drive or clip 'D' .*found are A, B, C"):
        list(opened(tmp_path, group="street", split={"by": "name", "val": ["B", "D"]}).frames("train"))


def test_images_are_split_by_a_number_of_the_record(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, *(record(number, at=10 * number) for number in range(4)))
    split = {"by": "frame", "field": "at", "train": [0, 20], "val": [20, 30]}
    datasets = opened(tmp_path, split=split)
    found = {split: [frame.source for frame, _ in datasets.frames(split)] for split in SPLITS}
    assert found == {"train": ["0.jpg", "1.jpg"], "val": ["2.jpg"], "test": []}
    for field in ("number", "image"):
        with pytest.raises(LabelError, match=rf"labels\.jsonl:1: 0\.jpg has no number '{field}'"):
            list(opened(tmp_path, split=split | {"field": field}).frames("train"))


def test_records_with_a_skipped_field_are_left_out(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, record(1), record(2, copy_of="1.jpg"), record(3))
    assert [frame.source for frame in frames_of(tmp_path, skip=["copy_of"])] == ["1.jpg", "3.jpg"]


def test_masks_are_painted_over_when_images_are_read(tmp_path: Path, draw: Draw) -> None:
    write_stills(tmp_path, draw, record(1))
    ((_, original),) = opened(tmp_path).frames("train")
    ((_, image),) = opened(tmp_path, masks=[[0.5, 0.5, 0.75, 0.8]]).frames("train")
    changed = (image != original).any(axis=-1)
    inside = np.zeros_like(changed)
    inside[HEIGHT // 2 : round(0.8 * HEIGHT), WIDTH // 2 : 3 * WIDTH // 4] = True
    assert changed[inside].mean() > 0.5
    assert not changed[~inside].any()


def test_a_stamp_disappears_under_its_mask() -> None:
    plain = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    stamped = plain.copy()
    stamped[20:40, 200:260] = 255
    # OpenCV's inpainting is a few levels off even where all colors are equal.
    np.testing.assert_allclose(without_boxes(stamped, [(0.6, 0.1, 0.85, 0.25)]), plain, atol=6)
    assert without_boxes(stamped, []) is stamped


@pytest.mark.parametrize("box", [[0.5, 0.1, 0.4, 0.2], [0.1, 0.2, 0.3, 0.2]])
def test_an_empty_mask_is_refused(tmp_path: Path, box: list[float]) -> None:
    with pytest.raises(SettingsError, match="a box of masks is empty"):
        opened(tmp_path, masks=[box])


def test_the_check_counts_splits_kinds_types_and_colors(tmp_path: Path, draw: Draw) -> None:
    lanes = [
        {"points": LEFT, "type": "unknown", "color": "yellow"},
        {"points": RIGHT, "type": "curb"},
        {"points": RIGHT, "type": "unknown"},
    ]
    write_stills(tmp_path, draw, record(1, lanes, split="val"), record(2, split="train"), record(3, split="train"))
    lines = check_dataset(tmp_path).contents.lines()
    expected = ["splits: train: 2, val: 1", "kinds: marking: 3, road_edge: 1, unknown: 1", "types: solid: 2, kerb: 1"]
    assert [line for line in lines if line.split(":")[0] in ("splits", "kinds", "types")] == expected
    assert "colors: white: 2, yellow: 1" in lines


def test_the_contact_sheet_shows_edges_of_the_road_as_dots(tmp_path: Path) -> None:
    line = np.array([[160.0, 170.0], [160.0, 20.0]])
    black = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    drawn = {}
    for name in ("solid", "kerb"):
        lane = LabeledLane(line, position=1, type=name)
        sheet = ContactSheet(tmp_path / "sheet.png")
        sheet.add(LabeledFrame(WIDTH, HEIGHT, (lane,), "a", "a"), black)
        drawn[name] = sheet._page()[20:170, 160].max(axis=-1) > 60
    assert drawn["solid"].all()
    assert 10 < np.count_nonzero(np.diff(drawn["kerb"].astype(int)) == 1) < 25


def test_clip_records_still_need_no_fields(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.jsonl", clip_record(image="a.jpg"))
    (frame,) = read(tmp_path)
    assert (frame.coverage, frame.horizon, frame.conditions) == (PARTIAL, None, {})
