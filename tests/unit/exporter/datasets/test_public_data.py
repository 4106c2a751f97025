"""The public data sets: where they come from, and whether a copy is whole."""

from __future__ import annotations

from pathlib import Path

import pytest
from click.testing import CliRunner

from lanestream.errors import LabelError, SettingsError
from lanestream_exporter.data_commands import data
from lanestream_exporter.datasets import public_data
from lanestream_exporter.datasets.manifest import DatasetCollection
from lanestream_exporter.datasets.public_data import check_sources, checksums_of, public_sources
from lanestream_exporter.toml_files import read_toml

SOURCE = public_data.PublicSource(
    folder="roads", title="Roads", page="https://example.org", license="MIT", download="all of it", prepare="nothing",
    files=("labels.jsonl",), images=("images",),
)  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Returns a data folder that is as its checksums say."""
    root = tmp_path / "data"
    (root / "roads" / "images").mkdir(parents=True)
    (root / "roads" / "labels.jsonl").write_text("{}\n")
    for name in ("a.jpg", "b.jpg", ".hidden"):
        (root / "roads" / "images" / name).write_text(name)
    sums = checksums_of([SOURCE], root)
    lines = [
        f"[[{kind}]]\n" + "".join(f"{k} = {v!r}\n" for k, v in each.items()) for kind in sums for each in sums[kind]
    ]
    (tmp_path / "checksums.toml").write_text("\n".join(lines))
    monkeypatch.setattr(public_data, "CHECKSUMS", tmp_path / "checksums.toml")
    return root


def state(folder: Path) -> tuple[str, tuple[str, ...]]:
    (status,) = check_sources([SOURCE], folder)
    return status.state, status.problems


def test_a_whole_copy_is_present(folder: Path) -> None:
    assert state(folder) == ("present", ())


def test_missing_files_are_named(folder: Path) -> None:
    (folder / "roads" / "labels.jsonl").unlink()
    assert state(folder) == ("missing", ("roads/labels.jsonl is missing",))
    assert state(folder / "nothing") == ("missing", ("roads/labels.jsonl is missing", "roads/images is missing"))


def test_other_content_is_different(folder: Path) -> None:
    (folder / "roads" / "labels.jsonl").write_text("[]\n")
    assert state(folder) == ("different", ("roads/labels.jsonl has another content",))
    (folder / "roads" / "images" / "a.jpg").write_text("other image")
    (folder / "roads" / "labels.jsonl").write_text("{}\n")
    assert state(folder) == ("different", ("roads/images has 16 bytes instead of 10",))
    (folder / "roads" / "images" / "a.jpg").unlink()
    assert state(folder) == ("different", ("roads/images has 1 files instead of 2",))


def test_every_data_set_of_the_shipped_manifest_has_a_source_and_checksums() -> None:
    sources = {source.folder: source for source in public_sources()}
    for spec in DatasetCollection.open().manifest.dataset:
        assert Path(spec.path).parts[0] in sources
    checksums = read_toml(public_data.CHECKSUMS, public_data._Checksums, "")
    known = {each.path for each in (*checksums.file, *checksums.folder)}
    assert known == {f"{name}/{part}" for name, each in sources.items() for part in (*each.files, *each.images)}


def test_the_command_shows_where_a_missing_data_set_comes_from(tmp_path: Path) -> None:
    result = CliRunner().invoke(data, ["fetch", "moscow_city", "--data", str(tmp_path)])
    assert isinstance(result.exception, LabelError)
    assert str(result.exception).startswith(f"1 missing in {tmp_path} (name the folder of the data sets")
    for text in (
        "│ missing │",
        "roadline-semantic-segmentation at ed07610",
        f"put it into: {tmp_path / 'moscow_city'}",
    ):
        assert text in result.output


def test_an_unknown_name_is_refused() -> None:
    with pytest.raises(SettingsError, match=r"no public data set 'kitti' \(accepted are tusimple, "):
        public_sources("kitti")


def test_missing_public_data_are_one_line_without_a_path_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LANESTREAM_DATA", raising=False)
    monkeypatch.chdir("/")
    with pytest.raises(LabelError) as caught:
        list(DatasetCollection.open().frames("test"))
    assert str(caught.value) == (
        "the data set 'TuSimple 0313-1' is missing (`lanestream data fetch` shows where it comes from; name its folder "
        "with --data or LANESTREAM_DATA)"
    )
