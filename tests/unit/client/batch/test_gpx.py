"""Tracks from GPX files, and which belongs to a video."""

from __future__ import annotations

from pathlib import Path

import pytest
from batches import write_clip

from lanestream.errors import SourceError
from lanestream_client.batch import gpx
from lanestream_client.batch.gpx import Track, Tracks, VideoTime, find_tracks, iso_time, read_gpx, video_time

NOON = 1714564800.0  # 2024-05-01T12:00:00Z


def write_gpx(path: Path, *points: tuple[float, float, float | str]) -> Path:
    """Writes a track of (longitude, latitude, time); a number is seconds from NOON."""
    lines = []
    for longitude, latitude, time in points:
        text = time if isinstance(time, str) else iso_time(NOON + time)
        lines.append(f'<trkpt lat="{latitude}" lon="{longitude}"><ele>4</ele><time>{text}</time></trkpt>')
    content = (
        f"<trk><trkseg>{''.join(lines)}</trkseg></trk><wpt lat='0' lon='0'><time>2001-01-01T00:00:00Z</time></wpt>"
    )
    path.write_text(f'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1">{content}</gpx>')
    return path


def test_positions_are_interpolated_and_gaps_are_not(tmp_path: Path) -> None:
    track = read_gpx(write_gpx(tmp_path / "a.gpx", (13.0, 52.0, 0), (13.2, 52.1, 10), (14.0, 53.0, 40)))
    assert track.times == (NOON, NOON + 10, NOON + 40)
    assert track.position(NOON) == (13.0, 52.0)
    assert track.position(NOON + 2.5) == (13.05, 52.025)
    assert track.position(NOON + 40) == (14.0, 53.0)
    assert [track.position(NOON + time) for time in (-0.1, 20, 40.1)] == [None, None, None]


def test_a_track_across_the_180th_meridian() -> None:
    track = Track((0.0, 10.0), ((179.9, 10.0), (-179.9, 10.0)))
    assert [track.position(time) for time in (2.5, 7.5)] == [(179.95, 10.0), (-179.95, 10.0)]


def test_times_have_zones_or_are_utc(tmp_path: Path) -> None:
    path = write_gpx(tmp_path / "a.gpx", (1, 2, "2024-05-01T14:00:01+02:00"), (1, 2, "2024-05-01T12:00:00.500"))
    assert read_gpx(path).times == (NOON + 0.5, NOON + 1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("no xml", "not a valid GPX file: syntax error"),
        ("<gpx></gpx>", "has no track: fewer than two points have a time"),
        ("<gpx><trkpt lat='1' lon='2'/></gpx>", "has no track"),
        ("<gpx><trkpt lat='1'><time>2024-05-01T12:00:00Z</time></trkpt></gpx>", "not a valid GPX file: 'lon'"),
        ("<gpx><trkpt lat='x' lon='1'><time>2024-05-01T12:00:00Z</time></trkpt></gpx>", "could not convert string"),
        ("<gpx><trkpt lat='91' lon='1'><time>2024-05-01T12:00:00Z</time></trkpt></gpx>", r"is at \(1.0, 91.0\)"),
        ("<gpx><trkpt lat='nan' lon='1'><time>2024-05-01T12:00:00Z</time></trkpt></gpx>", r"is at \(1.0, nan\)"),
        ("<gpx><trkpt lat='1' lon='1'><time>yesterday</time></trkpt></gpx>", "Invalid isoformat string"),
        ('<!DOCTYPE x [<!ENTITY a "b">]><gpx>&a;</gpx>', "not a valid GPX file: EntitiesForbidden"),
    ],
)
def test_bad_tracks_are_refused(tmp_path: Path, content: str, message: str) -> None:
    path = tmp_path / "a.gpx"
    path.write_text(content)
    with pytest.raises(SourceError, match=message):
        read_gpx(path)


def test_large_and_missing_tracks_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(SourceError, match=r"can't read .*none\.gpx: no such file or directory"):
        read_gpx(tmp_path / "none.gpx")
    monkeypatch.setattr(gpx, "_MOST_BYTES", 1 << 20)
    (tmp_path / "large.gpx").write_bytes(b" " * (1 << 21))
    with pytest.raises(SourceError, match="has more than 1 MB"):
        read_gpx(tmp_path / "large.gpx")


def test_a_folder_of_tracks(tmp_path: Path) -> None:
    write_gpx(tmp_path / "a.gpx", (1, 2, 0), (1, 2, 1))
    (tmp_path / "more").mkdir()
    write_gpx(tmp_path / "more" / "b.GPX", (1, 2, 10), (1, 2, 12))
    (tmp_path / "bad.gpx").touch()
    notes: list[str] = []
    tracks = find_tracks(tmp_path, 3.0, notes.append)
    assert tracks.spans == {
        str(tmp_path / "a.gpx"): (NOON, NOON + 1),
        str(tmp_path / "more" / "b.GPX"): (NOON + 10, NOON + 12),
    }
    assert tracks.offset_s == 3.0
    assert len(notes) == 1
    assert notes[0].startswith(f"warning: {tmp_path}/bad.gpx is not a valid GPX file")
    with pytest.raises(SourceError, match=r"bad\.gpx is not a valid"):
        find_tracks(tmp_path / "bad.gpx", 0.0, notes.append)
    (tmp_path / "empty").mkdir()
    with pytest.raises(SourceError, match="no GPX file with a track in"):
        find_tracks(tmp_path / "empty", 0.0, notes.append)


def test_which_track_belongs_to_a_video(tmp_path: Path) -> None:
    first = str(write_gpx(tmp_path / "Drive1.gpx", (1, 2, 0), (1, 2, 9)))
    second = str(write_gpx(tmp_path / "other.gpx", (3, 4, 100), (3, 4, 109)))
    spans = {first: (NOON, NOON + 9), second: (NOON + 100, NOON + 109)}
    tracks = Tracks(spans)
    # By its name, from its creation time or with its track.
    assert tracks.match("/v/drive1.mp4", VideoTime(NOON + 4, 9)) == (read_gpx(Path(first)), NOON + 4)
    assert tracks.match("/v/drive1.mp4", VideoTime(None, 9)) == (read_gpx(Path(first)), NOON)
    # By its time, also if it begins before the track.
    assert tracks.match("/v/x.mp4", VideoTime(NOON + 95, 9))[0] == read_gpx(Path(second))
    for video, time in (
        ("x", VideoTime(None, 9)),
        ("x", VideoTime(NOON + 50, 9)),
        ("drive1", VideoTime(NOON + 100, 9)),
    ):
        with pytest.raises(SourceError, match="no positions: "):
            tracks.match(f"/v/{video}.mp4", time)
    # A camera whose clock is an hour ahead.
    ahead = Tracks(spans, offset_s=-3600.0)
    assert ahead.match("/v/x.mp4", VideoTime(NOON + 3705, 3)) == (read_gpx(Path(second)), NOON + 105)
    assert ahead.match("/v/drive1.mp4", VideoTime(None, 3))[1] == NOON - 3600.0


def test_when_a_video_was_recorded(tmp_path: Path) -> None:
    time = video_time(str(write_clip(tmp_path / "a.mp4", 5, created="2024-05-01T12:00:00Z")))
    assert (time.created, time.duration_s) == (NOON, pytest.approx(0.2))
    assert video_time(str(write_clip(tmp_path / "b.mp4", 5))).created is None
    assert video_time(str(write_clip(tmp_path / "c.mp4", 5, created="1970-01-01T00:00:00Z"))).created is None
    with pytest.raises(SourceError, match=r"can't open .*none\.mp4"):
        video_time(str(tmp_path / "none.mp4"))
