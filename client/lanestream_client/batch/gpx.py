"""GPS tracks from GPX files: reading them, matching them to videos, and positions by time.

Times are UTC in seconds since 1970, positions are [longitude, latitude] in degrees (WGS 84).
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from lanestream.errors import SourceError, needs_extra, one_line

# A day of points, one per second, has about 15 MB.
_MOST_BYTES: Final = 128 << 20
# No position is interpolated between points that are further apart in seconds: the road between them is unknown.
_LONGEST_GAP_S: Final = 15.0
# Cameras whose clock is not set write a date at the beginning of some epoch.
_FIRST_YEAR: Final = 1990

Position = tuple[float, float]


@dataclass(frozen=True)
class Track:
    """A track: ascending `times` and the position at each."""

    times: tuple[float, ...]
    positions: tuple[Position, ...]

    def position(self, time: float) -> Position | None:
        """Returns the position at a time, interpolated; None outside of the track and in its gaps."""
        after = bisect_left(self.times, time)
        if after == len(self.times):
            return None
        if self.times[after] == time:
            return self.positions[after]
        if after == 0 or self.times[after] - self.times[after - 1] > _LONGEST_GAP_S:
            return None
        share = (time - self.times[after - 1]) / (self.times[after] - self.times[after - 1])
        (east, north), (to_east, to_north) = self.positions[after - 1], self.positions[after]
        # The short way round: a track may cross the 180th meridian.
        turn = (to_east - east + 180.0) % 360.0 - 180.0
        longitude = (east + share * turn + 180.0) % 360.0 - 180.0
        return round(longitude, 7), round(north + share * (to_north - north), 7)


@dataclass(frozen=True)
class VideoTime:
    """When a video was recorded: its creation time, if the file has one, and its duration in seconds."""

    created: float | None
    duration_s: float


class Tracks:
    """The GPX files of a batch: the time span of each by its path. `offset_s` is added to the times of the videos."""

    def __init__(self, spans: Mapping[str, tuple[float, float]], offset_s: float = 0.0) -> None:
        self.spans = spans
        self.offset_s = offset_s
        # Videos of one drive come one after the other.
        self._last: tuple[str, Track] | None = None

    def match(self, video: str, time: VideoTime) -> tuple[Track, float]:
        """Returns the track of a video, and the time of its first frame on the track's clock.

        The track of the same name is taken, else one that covers the video's time. Without a creation time, a video
        begins with the track of its name. Raises SourceError if no track fits.
        """
        named = next((path for path in self.spans if _stem(path) == _stem(video)), None)
        start = None if time.created is None else time.created + self.offset_s
        if start is None and named is not None:
            return self._read(named), self.spans[named][0] + self.offset_s
        if start is None:
            raise SourceError("no positions: the video has no creation time", "name its GPX file like the video")
        end = start + time.duration_s
        for path in self.spans if named is None else [named]:
            first, last = self.spans[path]
            if start <= last and end >= first:
                return self._read(path), start
        raise SourceError(
            f"no positions: no track covers {iso_time(start)} to {iso_time(end)}",
            "if the camera's clock is wrong, give --gpx-offset",
        )

    def _read(self, path: str) -> Track:
        if self._last is None or self._last[0] != path:
            self._last = path, read_gpx(Path(path))
        return self._last[1]


def find_tracks(source: Path, offset_s: float, notify: Callable[[str], object]) -> Tracks:
    """Returns the tracks of a GPX file, or of all GPX files in a folder and below it.

    `notify` gets a line for each file of a folder that can't be used. Raises SourceError if none can, and
    MissingExtraError without defusedxml.
    """
    if not source.is_dir():
        files = [source]
    else:
        files = sorted(path for path in source.rglob("*") if path.suffix.lower() == ".gpx")
    spans: dict[str, tuple[float, float]] = {}
    for path in files:
        try:
            track = read_gpx(path)
        except SourceError as error:
            if not source.is_dir():
                raise
            notify(f"warning: {error}")
        else:
            spans[str(path)] = track.times[0], track.times[-1]
    if not spans:
        raise SourceError(f"no GPX file with a track in {source}", "give a GPX file, or a folder with such files")
    return Tracks(spans, offset_s)


def read_gpx(path: Path) -> Track:
    """Returns the points of a GPX file that have a time, of all its tracks. Raises SourceError."""
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise SourceError(f"{path} has more than {_MOST_BYTES >> 20} MB", "divide the track")
        points = dict(_points(path))
    except OSError as error:
        raise SourceError(f"can't read {path}: {(error.strerror or str(error)).lower()}", "give a GPX file") from None
    if len(points) < 2:
        raise SourceError(f"{path} has no track: fewer than two points have a time", "give a recorded GPX track")
    times = tuple(sorted(points))
    return Track(times, tuple(points[time] for time in times))


def video_time(path: str) -> VideoTime:
    """Returns when a video was recorded, as its file says. Raises SourceError if it can't be opened."""
    import av

    try:
        with av.open(f"file:{path}") as container:
            text, duration = container.metadata.get("creation_time"), container.duration or 0
    except (av.FFmpegError, OSError) as error:
        raise SourceError(f"can't open {path}: {one_line(error)}") from None
    created = None
    with suppress(ValueError):
        created = _seconds(text) if text else None
    if created is not None and datetime.fromtimestamp(created, UTC).year < _FIRST_YEAR:
        created = None
    return VideoTime(created, duration / 1e6)


def iso_time(time: float) -> str:
    """Returns a time as ISO 8601 text with milliseconds, in UTC."""
    return datetime.fromtimestamp(time, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _points(path: Path) -> Iterator[tuple[float, Position]]:
    with needs_extra("batch"):
        from defusedxml import DefusedXmlException
        from defusedxml.ElementTree import ParseError, iterparse
    try:
        for _, element in iterparse(str(path)):
            if element.tag.rpartition("}")[2] != "trkpt":
                continue
            time = next((child.text for child in element if child.tag.rpartition("}")[2] == "time"), None)
            if time:
                position = float(element.attrib["lon"]), float(element.attrib["lat"])
                if not (abs(position[0]) <= 180.0 and abs(position[1]) <= 90.0):
                    raise ValueError(f"the point at {time} is at {position}")
                yield _seconds(time), position
            element.clear()
    except (ParseError, DefusedXmlException, ValueError, KeyError) as error:
        raise SourceError(f"{path} is not a valid GPX file: {one_line(error)}", "give a GPX file") from None


def _seconds(text: str) -> float:
    time = datetime.fromisoformat(text.strip())
    return (time if time.tzinfo is not None else time.replace(tzinfo=UTC)).timestamp()


def _stem(path: str) -> str:
    return Path(path).stem.casefold()
