"""Which files the sources of a batch name, and their units."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lanestream.errors import SourceError
from lanestream_client.batch.units import SourceFile, Unit, find_files, units_of


@pytest.fixture
def archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with videos, images and other files."""
    monkeypatch.chdir(tmp_path)
    for name in ("b/2.MP4", "b/10.mp4", "b/deep/x.jpg", "a.mkv", "list", "b/notes.txt", ".cache/y.mp4", "out/z.mp4"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return tmp_path


def found(folder: Path, *sources: str) -> tuple[list[str], list[str]]:
    """Returns the files that the sources name, as paths from the folder, and what was reported."""
    notes: list[str] = []
    files = find_files(sources, notes.append, Path("out"))
    return [os.path.relpath(file.path, folder) for file in files], notes


def test_folders_are_read_with_all_below_them(archive: Path) -> None:
    everything = ["a.mkv", "b/2.MP4", "b/10.mp4", "b/deep/x.jpg"]
    notes = ["skipped everything but videos and images (.txt: 1, files without a suffix: 1)"]
    assert found(archive, ".") == (everything, notes)
    assert found(archive, "b", str(archive / "b" / "..")) == (
        [*everything[1:], "a.mkv"],
        [notes[0].replace("1,", "2,")],
    )


def test_files_patterns_and_lists(archive: Path) -> None:
    (archive / "@list.mp4").touch()
    (archive / "list").write_text("b/10.mp4\n\n*.mkv\n")
    (archive / "[x].mp4").touch()
    assert found(archive, "b/10.mp4") == (["b/10.mp4"], [])
    assert found(archive, "**/*.[mM][pP]4")[0] == ["@list.mp4", "[x].mp4", "b/2.MP4", "b/10.mp4", "out/z.mp4"]
    assert found(archive, "@list")[0] == ["b/10.mp4", "a.mkv"]
    assert found(archive, "@list.mp4", "[x].mp4")[0] == ["@list.mp4", "[x].mp4"]
    (archive / "list").write_text("@list\n")
    with pytest.raises(SourceError, match="names another list, @list"):
        found(archive, "@list")


def test_links_do_not_lead_in_circles(archive: Path) -> None:
    (archive / "b" / "loop").symlink_to(archive)
    (archive / "b" / "same.mp4").symlink_to(archive / "b" / "10.mp4")
    (archive / "b" / "gone.mp4").symlink_to(archive / "missing")
    names, notes = found(archive, "b")
    assert names == ["b/2.MP4", "b/10.mp4", "b/deep/x.jpg", "b/gone.mp4", "b/same.mp4"]
    assert notes == ["skipped everything but videos and images (.txt: 1, links to folders: 1)"]


def test_sources_without_videos_or_images_are_refused(archive: Path) -> None:
    (archive / "empty").mkdir()
    with pytest.raises(SourceError, match="no videos or images in empty, empty") as caught:
        found(archive, "empty", "empty")
    assert ".mp4" in caught.value.hint


def test_units_are_videos_and_images_of_one_folder_the_largest_first() -> None:
    images = [SourceFile(f"/{folder}/{number}.jpg", 10, 0) for folder in "ab" for number in range(250)]
    videos = [SourceFile("/a/small.mp4", 5, 0), SourceFile("/a/large.mp4", 9000, 0)]
    units = units_of([*images, *videos])
    assert [(unit.kind, len(unit.files), unit.size) for unit in units] == [
        ("video", 1, 9000),
        ("images", 200, 2000),
        ("images", 200, 2000),
        ("images", 50, 500),
        ("images", 50, 500),
        ("video", 1, 5),
    ]
    assert sorted(file.path for unit in units for file in unit.files) == sorted(f.path for f in [*images, *videos])
    assert all(len({Path(file.path).parent for file in unit.files}) == 1 for unit in units)


def test_names_of_units_are_stable_readable_and_different() -> None:
    def name(*paths: str) -> str:
        files = tuple(SourceFile(path, 1, 2) for path in paths)
        return Unit("video" if len(paths) == 1 else "images", files).name

    assert name("/a/drive.mp4") == "drive.mp4-bd9fed61ff5a"
    paths = (
        "/a/drive.mp4",
        "/b/drive.mp4",
        "/a/Drive.mp4",
        "/a/drive.mkv",
        "/a/\udcff.mp4",
        "/a/\udcfe.mp4",
        "/a/..x y",
    )
    names = [*map(name, paths), name("/a/b", "/a/c"), name("/a/b", "/a/d"), name("/a/b\0/a/c")]
    assert len({each.casefold() for each in names}) == len(names)
    assert name("/a/1.jpg", "/a/2.jpg").startswith("a-")
    assert name("/a/..x y.mp4").startswith("x_y.mp4-")
    for path in ("/a/" + 90 * "日本" + ".mp4", "/a/_.mp4", "/a/\n\t.mp4", "/a/\udcff.mp4"):
        assert len(name(path).encode()) <= 200
        assert name(path).isprintable()
        assert not name(path).startswith((".", "_", "-"))


def test_a_unit_without_one_of_its_files() -> None:
    one, two = SourceFile("/a/1.jpg", 1, 1), SourceFile("/a/2.jpg", 1, 1)
    assert Unit("images", (one, two)).without(one.path) == Unit("images", (two,))
    assert Unit("images", (one,)).without(one.path) is None
