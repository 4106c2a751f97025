"""The result files of a unit while they are written."""

from __future__ import annotations

from pathlib import Path

import fakes
import numpy as np
import pyarrow.parquet
import pytest
from batches import full_disk

from lanestream.errors import WriteError
from lanestream.local import LocalEngine
from lanestream.protocol import ErrorMessage, LanesMessage
from lanestream_client.batch.outputs import Format, create_folders, publish, unit_files, unit_writer
from lanestream_client.frames import SourceFrame, StreamResult


@pytest.fixture(scope="module")
def lanes() -> LanesMessage:
    """The message of a frame with two boundaries."""
    return LocalEngine(fakes.engine()).open_camera().lanes(fakes.picture(), seq=0, timestamp=0.0)


def result(lanes: LanesMessage, seq: int) -> StreamResult:
    return StreamResult(SourceFrame(seq, None), lanes=lanes.model_copy(update={"seq": seq, "timestamp": seq / 25}))


@pytest.mark.parametrize("kind", ["jsonl", "parquet"])
def test_files_on_a_full_disk_are_removed(kind: Format, lanes: LanesMessage, tmp_path: Path) -> None:
    create_folders(tmp_path, kind, tracks=False)
    noise = np.random.default_rng(4)
    with (  # noqa: PT012 - fails at any of its writes
        full_disk(10_000),
        pytest.raises(WriteError, match=f"can't write {tmp_path}: file too large"),
        unit_files(tmp_path, "name") as files,
        unit_writer(files, tmp_path, kind) as writer,
    ):
        for seq in range(500):
            random = [lane.model_copy(update={"age_s": noise.random()}) for lane in lanes.lanes]
            writer.write("/a.mp4", result(lanes.model_copy(update={"lanes": random}), seq))
    assert [path for path in tmp_path.glob("*/*") if path.is_file()] == []


def test_a_long_video_has_several_groups_of_rows(lanes: LanesMessage, tmp_path: Path) -> None:
    create_folders(tmp_path, "parquet", tracks=False)
    with unit_files(tmp_path, "name") as files:
        with unit_writer(files, tmp_path, "parquet") as writer:
            for seq in range(2500):
                writer.write("/a.mp4", result(lanes, seq))
            error = ErrorMessage(code="bad_image", message="it is damaged", seq=2500)
            writer.write("/a.mp4", StreamResult(SourceFrame(2500, None), error=error))
        publish(tmp_path, files.finish())
    frames = pyarrow.parquet.ParquetFile(tmp_path / "frames" / "name.parquet")
    assert (frames.num_row_groups, frames.metadata.num_rows) == (2, 2501)
    table = frames.read().to_pylist()
    assert [row["seq"] for row in table] == list(range(2501))
    assert (table[-1]["error"], table[-1]["lanes"], table[0]["error"]) == ("it is damaged", None, None)
    assert pyarrow.parquet.read_table(tmp_path / "lanes" / "name.parquet").num_rows == 5000


@pytest.mark.parametrize("kind", ["jsonl", "parquet"])
def test_a_video_without_boundaries_has_its_frames(kind: Format, tmp_path: Path) -> None:
    create_folders(tmp_path, kind, tracks=False)
    with unit_files(tmp_path, "name") as files:
        with unit_writer(files, tmp_path, kind) as writer:
            writer.write("/a.mp4", StreamResult(SourceFrame(0, None), lanes=fakes.lanes(0)))
        publish(tmp_path, files.finish())
    if kind == "parquet":
        assert pyarrow.parquet.read_table(tmp_path / "lanes").num_rows == 0
        assert pyarrow.parquet.read_table(tmp_path / "frames").to_pylist()[0]["lanes"] == 0
    else:
        assert len((tmp_path / "frames" / "name.jsonl").read_text().splitlines()) == 1
