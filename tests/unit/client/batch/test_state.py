"""What a batch remembers, and what it makes of interruptions at each of its steps."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from lanestream.errors import BatchError, WriteError
from lanestream_client.batch import state as state_module
from lanestream_client.batch.outputs import UnitFiles, create_folders
from lanestream_client.batch.state import Counts, UnitResult, open_state
from lanestream_client.batch.units import SourceFile, Unit

ONE, TWO, THREE = (SourceFile(f"/d/{number}.jpg", number, 5) for number in (1, 2, 3))


def result(out: Path, *files: SourceFile, failed: dict[str, str] | None = None, frames: int = 1) -> UnitResult:
    """Returns the outcome of a unit with its result file written."""
    create_folders(out, "jsonl", tracks=False)
    unit = Unit("images", files)
    written = UnitFiles(out, unit.name)
    written.create("frames", "jsonl").write(b"{}\n")
    return UnitResult(unit, written.finish(), Counts(frames=frames, video_s=0.5), failed or {})


def published(out: Path) -> set[str]:
    return {path.name.split("-")[0] for path in (out / "frames").iterdir()}


def names(out: Path) -> list[str]:
    return sorted(path.name for path in (out / "frames").iterdir())


def test_recorded_units_are_not_pending(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        assert state.pending([ONE, TWO], retry_failed=False) == [ONE, TWO]
        assert state.record(result(tmp_path, ONE, TWO, failed={TWO.path: "it is bad"}))
    with open_state(tmp_path) as state:
        assert state.pending([ONE, TWO, THREE], retry_failed=False) == [THREE]
        assert state.pending([ONE, TWO, THREE], retry_failed=True) == [TWO, THREE]
        assert state.failed([ONE, TWO]) == {TWO.path: "it is bad"}
        assert state.failed([ONE, THREE]) == {}
        assert state.numbers() == (1, 1)
        assert state.record(result(tmp_path, TWO))
        assert state.numbers() == (2, 0)
        assert state.totals() == Counts(frames=2, video_s=1.0)
        assert len(names(tmp_path)) == 2


def test_a_unit_that_was_done_twice_counts_once(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        assert state.record(result(tmp_path, ONE, TWO))
        before = names(tmp_path)
        assert not state.record(result(tmp_path, ONE, TWO))
        assert names(tmp_path) == before
        assert state.totals().frames == 1


def test_results_of_changed_files_are_removed(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        state.record(result(tmp_path, ONE, TWO))
        state.record(result(tmp_path, THREE))
        changed = SourceFile(ONE.path, ONE.size, ONE.mtime_ns + 1)
        # A source that was not named this time keeps its results.
        assert state.pending([changed, TWO], retry_failed=False) == [changed, TWO]
        assert len(names(tmp_path)) == 1
        assert state.pending([ONE, TWO, THREE], retry_failed=False) == [ONE, TWO]
        assert state.totals().frames == 1


def test_a_failed_file_that_has_changed_is_tried_again(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        state.record(UnitResult(Unit("video", (ONE,)), failed={ONE.path: "it is bad"}))
        assert state.pending([ONE], retry_failed=False) == []
        changed = SourceFile(ONE.path, 99, ONE.mtime_ns)
        assert state.pending([changed], retry_failed=False) == [changed]


def test_interrupted_before_it_was_recorded(tmp_path: Path) -> None:
    with open_state(tmp_path):
        result(tmp_path, ONE)
        assert len(names(tmp_path)) == 1
    assert names(tmp_path) == []
    with open_state(tmp_path) as state:
        assert state.pending([ONE], retry_failed=False) == [ONE]


def test_interrupted_between_the_record_and_the_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_state(tmp_path) as state, monkeypatch.context() as patch:
        patch.setattr(state_module, "publish", lambda *_: None)
        patch.setattr(state_module, "remove_parts", lambda *_: None)  # nor does it end in good order
        state.record(result(tmp_path, ONE))
        patch.undo()
        (part,) = names(tmp_path)
        (tmp_path / "frames" / part).rename(tmp_path / part)
    (tmp_path / part).rename(tmp_path / "frames" / part)
    with open_state(tmp_path) as state:
        assert state.pending([ONE], retry_failed=False) == []
    assert names(tmp_path) == [f"{Unit('images', (ONE,)).name}.jsonl"]


def test_interrupted_while_results_were_removed(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        state.record(result(tmp_path, ONE))
    (tmp_path / "frames" / names(tmp_path)[0]).unlink()
    with open_state(tmp_path) as state:
        assert state.pending([ONE], retry_failed=False) == [ONE]
        assert state.totals() == Counts()


def test_settings_are_those_of_the_first_run(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        state.check_settings({"detector": None, "networks": {"candidates": "a1"}})
    with open_state(tmp_path) as state:
        state.check_settings({"networks": {"candidates": "a1"}, "detector": None})
        with pytest.raises(BatchError) as caught:
            state.check_settings({"detector": "regression", "networks": {"candidates": "b2"}})
    assert caught.value.message == (
        f'{tmp_path} has results of other settings: detector was null, is "regression"; '
        'networks was {"candidates": "a1"}, is {"candidates": "b2"}'
    )


def test_a_damaged_state_is_reported(tmp_path: Path) -> None:
    (tmp_path / "state.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(WriteError, match=r"can't use .*state\.sqlite: file is not a database"), open_state(tmp_path):
        pass


def test_the_state_can_be_read_while_the_batch_runs(tmp_path: Path) -> None:
    with open_state(tmp_path) as state:
        state.record(UnitResult(Unit("video", (ONE,)), failed={ONE.path: "it is bad"}))
        with sqlite3.connect(tmp_path / "state.sqlite") as connection:
            assert connection.execute("SELECT path, error FROM file").fetchall() == [(ONE.path, "it is bad")]
        connection.close()
