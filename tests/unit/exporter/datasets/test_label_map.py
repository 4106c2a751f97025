"""What labels of drawing programs mean: by their words, by a map, and if nothing is known about them."""

from __future__ import annotations

from pathlib import Path

import pytest
from labelfiles import (
    LEFT,
    RIGHT,
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
from lanestream_exporter.datasets.label_map import BY_WORDS, LabelMap
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.datasets.reading import read_dataset


@pytest.mark.parametrize(
    ("label", "meaning"),
    [
        ("lane", "lane"),
        ("bus_lane", "lane"),
        ("road_edge", "lane"),
        ("curb", "lane"),
        ("1", "lane"),
        ("ego left", "lane"),
        ("yellow", "lane"),
        ("stop_line", "ignore"),
        ("Crosswalk", "ignore"),
        ("lane_arrow", "ignore"),
        ("centerline", "lane"),
        ("guardrail", None),
        ("white van", None),
        ("\u505c\u6b62\u7ebf", None),
    ],
)
def test_lines_mean_what_their_words_say(label: str, meaning: str | None) -> None:
    assert BY_WORDS.meaning_of_line(label) == meaning


def test_a_map_goes_before_the_words() -> None:
    labels = LabelMap(lane=("stop line",), road_edge=("Guard-Rail",), ignore=("lane",))
    assert [labels.meaning(name) for name in ("Stop_Line", "guard rail", "LANE", "lanes")] == [
        "lane",
        "road_edge",
        "ignore",
        "lane",
    ]


@pytest.mark.parametrize(
    ("label", "types", "kind", "type_name"),
    [
        ("guardrail", [], "road_edge", "edge"),
        ("high curb", [], "road_edge", "kerb"),
        ("edge line", ["solid"], "marking", "solid"),
        ("edge line", [], None, None),
        # An attribute that was left over when the label was changed.
        ("road_edge", ["solid"], "road_edge", "edge"),
        ("lane", ["kerb"], "road_edge", "kerb"),
        ("lane", ["marking"], "marking", None),
    ],
)
def test_a_mapped_label_decides_the_kind(label: str, types: list[str], kind: str | None, type_name: str | None) -> None:
    labels = LabelMap(lane=("edge line",), road_edge=("guardrail", "high curb"))
    look = labels.look(label, types)
    assert (look.type, look.default_kind or ("road_edge" if look.type in ("kerb", "edge") else None)) == (
        type_name,
        kind if look.type is None or kind == "road_edge" else None,
    )


def write_drawings(folder: Path, draw: Draw, *labels: str) -> None:
    for number, label in enumerate(labels):
        draw(f"{number}.jpg")
        labelme(folder / f"{number}.json", f"{number}.jpg", line_strip(LEFT), line_strip(RIGHT, label))


def test_an_unknown_label_is_one_error_that_says_how_to_map_it(tmp_path: Path, draw: Draw) -> None:
    write_drawings(tmp_path, draw, "guardrail", "lane", "guardrail", "median")
    found = faults(tmp_path)
    assert len(found) == 2
    assert f"{tmp_path / '0.json'}: the label 'guardrail' of a line is not known" in found[0]
    assert "lane, road_edge or ignore" in found[0]
    assert "--label guardrail=ignore" in found[0]
    assert 'labels = { ignore = ["guardrail"] } in the manifest' in found[0]
    assert f"{tmp_path / '3.json'}: the label 'median'" in found[1]
    # The frames themselves are sound, with the boundaries that are known.
    assert check_dataset(tmp_path).contents.lanes == {1: 3, 2: 1}
    with pytest.raises(LabelError, match="the label 'guardrail'"):
        read(tmp_path)


def test_the_error_of_a_label_is_one_line_that_can_be_pasted(tmp_path: Path, draw: Draw) -> None:
    write_drawings(tmp_path, draw, 'tram "rail"\n2')
    (fault,) = faults(tmp_path)
    assert "--label 'tram \"rail\" 2=ignore'" in fault
    assert 'labels = { ignore = ["tram \\"rail\\" 2"] }' in fault
    labels = LabelMap.of(['tram "rail" 2=ignore'])
    assert [len(frame.lanes) for frame, _ in read_dataset(tmp_path, labels=labels)] == [1]


def test_a_map_says_what_the_labels_of_a_data_set_mean(tmp_path: Path, draw: Draw) -> None:
    write_drawings(tmp_path, draw, "guardrail", "median")
    labels = LabelMap(road_edge=("guardrail",), ignore=("median",))
    frames = [frame for frame, _ in read_dataset(tmp_path, labels=labels)]
    assert [[lane.kind for lane in frame.lanes] for frame in frames] == [[None, "road_edge"], [None]]


def test_shapes_of_other_tools_are_boundaries_by_the_map_only(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    outline = [[36.0, 170.0], [44.0, 170.0], [132.25, 100.0], [128.25, 100.0]]
    labelme(tmp_path / "a.json", "a.jpg", line_strip(RIGHT), line_strip(outline, "paint", "polygon"))
    assert len(read(tmp_path)[0].lanes) == 1
    ((frame, _),) = read_dataset(tmp_path, labels=LabelMap(lane=("paint",)))
    assert len(frame.lanes) == 2


def test_tracks_and_images_of_cvat_use_the_map(tmp_path: Path, draw: Draw) -> None:
    draw("images/a.png")
    write_cvat(tmp_path / "annotations.xml", cvat_image("a.png", polyline(LEFT), polyline(RIGHT, label="guardrail")))
    (fault,) = faults(tmp_path)
    assert "image a.png: the label 'guardrail' of a line is not known" in fault
    ((frame, _),) = read_dataset(tmp_path, labels=LabelMap(ignore=("guardrail",)))
    assert len(frame.lanes) == 1


def test_a_manifest_maps_labels(tmp_path: Path, draw: Draw) -> None:
    write_drawings(tmp_path, draw, "guardrail")
    spec = {"name": "roads", "path": ".", "split": "train", "labels": {"road_edge": ["guardrail"]}}
    manifest = write_manifest(tmp_path / "manifest.toml", spec)
    ((frame, _),) = DatasetCollection.open(manifest, tmp_path).frames("train")
    assert [lane.kind for lane in frame.lanes] == [None, "road_edge"]


def test_a_map_with_mistakes_is_refused(tmp_path: Path) -> None:
    spec = {"name": "roads", "path": ".", "split": "train", "labels": {"kerb": ["curb"]}}
    with pytest.raises(SettingsError, match=r"unknown key dataset\[0\]\.labels\.kerb .*lane, road_edge, ignore"):
        DatasetCollection.open(write_manifest(tmp_path / "a.toml", spec))
    spec["labels"] = {"lane": ["paint"], "ignore": ["Paint"]}
    with pytest.raises(SettingsError, match="the label 'paint' is listed twice"):
        DatasetCollection.open(write_manifest(tmp_path / "b.toml", spec))
    for pair in ("paint", "=lane", "paint=line"):
        with pytest.raises(SettingsError, match="doesn't map a label"):
            LabelMap.of([pair])
    with pytest.raises(SettingsError, match="the label 'paint' is listed twice"):
        LabelMap.of(["paint=lane", "Paint=ignore"])


def test_a_map_is_refused_for_labels_without_names(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.jsonl", clip_record(image="a.jpg"))
    with pytest.raises(LabelError, match="have no labels that could be mapped"):
        list(read_dataset(tmp_path, labels=LabelMap(ignore=("lane",))))
