"""The arithmetic of `tools/compare.py`, on made-up answers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import fakes
import pytest
from click.testing import CliRunner
from compare import CompareError, Differences, Pair, main, max_column_difference, pss_mb, read_frames, table


def answer(*lanes: tuple[int, int, float], width: int = 1280, rows: range = range(700, 400, -20)) -> dict[str, Any]:
    """An answer with vertical boundaries: their track id, position and column. Points go from the lowest row up."""
    return {
        "width": width,
        "lanes": [
            {"track_id": track, "position": position, "points": [[x, float(y)] for y in rows]}
            for track, position, x in lanes
        ],
    }


def test_ratios_are_of_the_same_round() -> None:
    pair = Pair.of([10.0, 40.0, 20.0], [9.0, 44.0, 20.0])
    assert (pair.base, pair.present) == (20.0, 20.0)
    assert (pair.ratio, pair.ratio_min, pair.ratio_max) == pytest.approx((1.0, 0.9, 1.1))


def test_columns_are_compared_at_640_wide_where_both_boundaries_reach() -> None:
    base = answer((1, -1, 400.0), (2, 1, 900.0))
    assert max_column_difference(base, base) == 0.0
    assert max_column_difference(base, answer((1, -1, 400.0), (2, 1, 906.0))) == pytest.approx(3.0)
    assert max_column_difference(base, answer((2, 1, 906.0), rows=range(600, 500, -7))) == pytest.approx(3.0)
    assert max_column_difference(base, answer((2, 1, 906.0), rows=range(300, 200, -7))) == 0.0
    assert max_column_difference(base, answer((3, 2, 906.0))) == 0.0
    assert max_column_difference(base, answer()) == 0.0


def test_differences_separate_other_lanes_from_other_columns() -> None:
    found = Differences()
    base = answer((1, -1, 400.0), (2, 1, 900.0))
    found.add(base, base)
    found.add(base, answer((1, -1, 400.0), (2, 1, 900.05)))  # rounding
    found.add(base, answer((1, -1, 402.0), (2, 1, 900.0)))
    found.add(base, answer((1, -1, 400.0), (3, 1, 904.0)))  # another id
    found.add(base, answer((1, -1, 400.0)))
    assert found == Differences(5, frames_with_other_lanes=2, frames_with_other_columns=1, largest_px_at_640=2.0)


def test_pss_is_read_from_smaps_rollup() -> None:
    text = "5581-7ffd ---p 0 00:00 0  [rollup]\nRss:      9000 kB\nPss:      2000 kB\nPss_Dirty:   10 kB\n"
    assert pss_mb(text) == pytest.approx(2.048)


def test_frames_of_a_folder_are_its_image_files_in_order(tmp_path: Path) -> None:
    for name in ("b.jpg", "a.png", "c.jpg"):
        (tmp_path / name).write_bytes(fakes.image_file(Path(name).suffix) + name.encode())
    (tmp_path / "notes.txt").write_text("no image")
    frames = read_frames(tmp_path, 2)
    assert [image[-5:] for image, _ in frames] == [b"a.png", b"b.jpg"]
    assert [timestamp for _, timestamp in frames] == [0.0, 0.04]


def test_a_path_without_frames_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(CompareError, match="is not a video or a folder with images"):
        read_frames(tmp_path, 2)


def test_the_table_has_a_row_for_each_quantity_and_each_detector() -> None:
    pair = {"base": 20.0, "present": 21.0, "ratio": 1.05, "ratio_min": 1.0, "ratio_max": 1.1}
    group = {"cpu_ms_per_frame": pair, "differences": {"frames": 8, "largest_px_at_640": 0.5}}
    report = {"base": "f" * 40, "frames": 8, "rounds": 2, "starts": 2, "detectors": {"candidates": group}}
    lines = list(table({**report, "service": {"pss_mb": pair}}))
    assert "| candidates | cpu_ms_per_frame | 20.00 | 21.00 | 1.050 | 1.000 | 1.100 |" in lines
    assert "| service | pss_mb | 20.00 | 21.00 | 1.050 | 1.000 | 1.100 |" in lines
    assert "| candidates | 8 | 0 | 0 | 0.500 |" in lines


def test_an_unknown_revision_is_an_error_in_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(main, ["--base", "no-such-revision", str(tmp_path)])
    assert result.exit_code == 1
    assert result.output.count("\n") == 1
    assert "is not a commit of this repository" in result.output
