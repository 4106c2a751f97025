"""Label files as other systems and programs write them: line ends, byte order marks, suffixes, paths, hidden files."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from labelfiles import (
    HEIGHT,
    LEFT,
    WIDTH,
    Draw,
    clip_record,
    cvat_image,
    draw_mask,
    faults,
    labelme,
    line_strip,
    polyline,
    read,
    tusimple_record,
    write_ccvl,
    write_cvat,
    write_lines,
    write_mask,
)

from lanestream.errors import LabelError

COLUMNS = [x for x, _ in reversed(LEFT)]


def write_tusimple(folder: Path) -> Path:
    write_lines(folder / "labels.json", tusimple_record("clips\\a\\1.jpg", COLUMNS))
    return folder / "labels.json"


def write_clip_labels(folder: Path) -> Path:
    write_lines(folder / "labels.jsonl", clip_record(image="clips\\a\\1.jpg"))
    return folder / "labels.jsonl"


def write_labelme(folder: Path) -> Path:
    labelme(folder / "labels.json", "clips\\a\\1.jpg", line_strip(LEFT))
    return folder / "labels.json"


def write_cvat_xml(folder: Path) -> Path:
    write_cvat(folder / "labels.xml", cvat_image("clips\\a\\1.jpg", polyline(LEFT)))
    return folder / "labels.xml"


def write_culane(folder: Path) -> Path:
    path = folder / "clips/a/1.lines.txt"
    path.write_text(" ".join(f"{x} {y}" for x, y in LEFT) + "\n")
    return path


WRITERS = [write_tusimple, write_clip_labels, write_labelme, write_cvat_xml, write_culane]
CHANGES: dict[str, Callable[[bytes], bytes]] = {
    "blank last line": lambda data: data + b"\n",
    "blank lines": lambda data: b"\n".join([data.rstrip(b"\n"), b"", b"  ", b"", b""]),
    "no last line end": lambda data: data.rstrip(b"\n"),
    "windows": lambda data: data.replace(b"\n", b"\r\n") + b"\r\n",
    "old mac": lambda data: data.replace(b"\n", b"\r"),
    "byte order mark": lambda data: b"\xef\xbb\xbf" + data,
    "utf-16": lambda data: data.decode().replace('encoding="utf-8"', 'encoding="utf-16"').encode("utf-16"),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("write", WRITERS)
def test_text_is_read_as_every_system_writes_it(
    tmp_path: Path, draw: Draw, write: Callable[[Path], Path], change: str
) -> None:
    draw("clips/a/1.jpg")
    path = write(tmp_path)
    path.write_bytes(CHANGES[change](path.read_bytes()))
    (frame,) = read(tmp_path)
    assert [lane.points.tolist() for lane in frame.lanes] == [LEFT]


@pytest.mark.parametrize("write", WRITERS)
def test_label_files_may_have_suffixes_in_upper_case(tmp_path: Path, draw: Draw, write: Callable[[Path], Path]) -> None:
    draw("clips/a/1.JPG")  # the labels name 1.jpg
    path = write(tmp_path)
    path.rename(path.with_name(path.name.upper()))
    (frame,) = read(tmp_path)
    assert frame.source == "clips/a/1.JPG"


@pytest.mark.parametrize("suffix", [".JPG", ".PNG", ".JPEG", ".WEBP"])
def test_the_image_of_a_mask_may_have_a_suffix_in_upper_case(tmp_path: Path, draw: Draw, suffix: str) -> None:
    draw(f"Images/a{suffix}")
    write_mask(tmp_path / "Masks" / "a.png", draw_mask((LEFT, 255)))
    (tmp_path / "Masks" / "a.png").rename(tmp_path / "Masks" / "a.PNG")
    (frame,) = read(tmp_path)
    assert (frame.source, len(frame.lanes)) == (f"Images/a{suffix}", 1)


def test_caltech_labels_name_an_image_in_upper_case(tmp_path: Path, draw: Draw) -> None:
    draw("cordova1/f00000.PNG")
    write_ccvl(tmp_path / "cordova1" / "labels.ccvl", [("f00000.png", [])])
    assert [frame.source for frame in read(tmp_path)] == ["cordova1/f00000.PNG"]


@pytest.mark.parametrize("suffix", [".MP4", ".MOV", ".avi"])
def test_a_video_has_the_name_of_its_labels_and_any_suffix(tmp_path: Path, clip: Path, suffix: str) -> None:
    shutil.copy(clip / "drive.mp4", tmp_path / f"drive{suffix}")
    write_lines(tmp_path / "drive.jsonl", clip_record())
    assert [(frame.source, frame.group) for frame in read(tmp_path)] == [(f"drive{suffix}#0", "drive")]


def test_clip_labels_may_be_called_json(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.json", clip_record(image="a.jpg"))
    (tmp_path / "camera.json").write_text('{"fx": 800}')
    assert len(read(tmp_path)) == 1


def test_lines_end_only_where_lines_end(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    record = json.dumps(clip_record(image="a.jpg", scene="exit\u2028ramp\u0085"), ensure_ascii=False)
    (tmp_path / "labels.jsonl").write_text(record + "\n", encoding="utf-8")
    assert read(tmp_path)[0].conditions["scene"] == "exit\u2028ramp\u0085"


def test_a_bad_line_after_blank_ones_is_reported_by_its_number(tmp_path: Path, draw: Draw) -> None:
    draw("a.jpg")
    write_lines(tmp_path / "labels.jsonl", "", clip_record(image="a.jpg"), "", "{", "")
    (fault,) = faults(tmp_path)
    assert "labels.jsonl:4: not JSON" in fault


def test_files_of_the_system_are_passed_over(tmp_path: Path, draw: Draw) -> None:
    draw("images/a.png")
    write_cvat(tmp_path / "annotations.xml", cvat_image("a.png", polyline(LEFT)))
    (tmp_path / "__MACOSX").mkdir()
    (tmp_path / "__MACOSX" / "._annotations.xml").write_bytes(b"\x00\x05\x16\x07")
    shutil.copytree(tmp_path / "images", tmp_path / ".ipynb_checkpoints" / "images")
    write_cvat(tmp_path / ".ipynb_checkpoints" / "annotations.xml", cvat_image("a.png", polyline(LEFT)))
    assert len(read(tmp_path)) == 1


_COCO = {
    "info": {},
    "images": [{"id": 0, "file_name": "a.jpg", "width": WIDTH, "height": HEIGHT}],
    "annotations": [{"id": 1, "image_id": 0, "category_id": 1, "segmentation": [[1, 2, 3, 4, 5, 6]]}],
    "categories": [{"id": 1, "name": "lanes", "supercategory": "none"}],
}
_VIA = {"a.jpg1": {"filename": "a.jpg", "regions": [{"shape_attributes": {"name": "polyline", "all_points_x": [1]}}]}}
_SUPERVISELY = {"size": {}, "objects": [{"geometryType": "line", "points": {"exterior": [[1, 2], [3, 4]]}}]}
_SCALABEL = [{"name": "a.jpg", "labels": [{"category": "lane", "poly2d": [{"vertices": [[1, 2]]}]}]}]
_VOC = "<annotation>\n<folder>x</folder><filename>a.jpg</filename>\n<object><name>lane</name></object></annotation>"
_LABELME_XML = (
    "<annotation><filename>a.jpg</filename><object><polygon><pt><x>1</x></pt></polygon></object></annotation>"
)


@pytest.mark.parametrize(
    ("name", "content", "program"),
    [
        ("_annotations.coco.json", _COCO, "COCO"),
        ("via_project.json", _VIA, "VIA (VGG Image Annotator)"),
        ("via.csv", "filename,file_size,region_count,region_shape_attributes\n", "VIA (VGG Image Annotator)"),
        ("ann/a.jpg.json", _SUPERVISELY, "Supervisely"),
        ("labels.json", _SCALABEL, "Scalabel or BDD100K"),
        ("a.xml", _VOC, "Pascal VOC (labelImg)"),
        ("a.xml", _LABELME_XML, "LabelMe 3.0 (XML)"),
        ("labels/a.txt", "0 0.5 0.5 0.1 0.9\n", "YOLO"),
        ("labels/a.txt", "0 0.5 0.5 0.1 0.9 0.2 0.8\n1 0.5 0.5 0.1 0.9 0.2 0.8", "YOLO"),
    ],
)
def test_labels_of_other_programs_are_refused_by_name(
    tmp_path: Path, draw: Draw, name: str, content: object, program: str
) -> None:
    draw("a.jpg")
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    for given in (tmp_path, path):
        with pytest.raises(LabelError) as caught:
            read(given)
        assert f"{path.name} has labels of {program}, which are not read" in str(caught.value)
        assert caught.value.hint
