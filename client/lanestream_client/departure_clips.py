"""Records a clip around each lane departure: a video with lanes and its results as lines of JSON."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import TYPE_CHECKING, Final

from lanestream.errors import SourceError
from lanestream.protocol import DepartureEventModel
from lanestream_client.sinks import json_lines_sink, video_sink

if TYPE_CHECKING:
    from lanestream_client.frames import StreamResult
    from lanestream_client.sinks import ResultSink

# The most memory for the frames before a departure. Clips of very large frames begin later.
_MOST_BYTES: Final = 256 << 20


class DepartureClips:
    """A sink that keeps the last `seconds` of results, and writes a clip when the vehicle leaves its lane.

    A clip begins `seconds` before a departure event and ends `seconds` after it, or after the last one if others follow
    before that. Its files `departure-SEQ-SIDE.mp4` and `.jsonl` in `folder` are named after the frame that showed it.
    `paths` are the videos so far. The files of an open clip are closed with `files`.
    """

    def __init__(self, folder: Path, seconds: float, fps: float, files: ExitStack) -> None:
        self.paths: list[Path] = []
        self._folder = folder
        self._seconds = seconds
        self._fps = fps
        self._files = files
        self._sinks: list[ResultSink] = []
        self._recent: deque[tuple[float, StreamResult]] = deque()
        self._bytes = 0
        self._time = 0.0
        self._until = 0.0

    def write_result(self, result: StreamResult) -> None:
        """Takes one result. Raises SourceError if a clip can't be written."""
        if result.lanes is not None:
            self._time = result.lanes.timestamp
        # As image files, a few seconds of frames take megabytes instead of gigabytes.
        result = replace(result, frame=replace(result.frame, data=result.frame.encoded(), pixels=None))
        self._remember(result)
        events = [] if result.lanes is None else result.lanes.events
        departures = [event for event in events if isinstance(event, DepartureEventModel)]
        if departures:
            self._until = self._time + self._seconds
        if departures and not self._sinks:
            self._open(self._folder / f"departure-{result.frame.seq:06}-{departures[0].side}.mp4")
            return
        for sink in self._sinks:
            sink.write_result(result)
        if self._time >= self._until:
            self._sinks = []
            self._files.close()

    def _remember(self, result: StreamResult) -> None:
        """Keeps a result, and forgets those of other times or beyond the memory."""
        self._recent.append((self._time, result))
        self._bytes += len(result.frame.data or b"")
        while abs(self._time - self._recent[0][0]) > self._seconds or (
            self._bytes > _MOST_BYTES and len(self._recent) > 1
        ):
            _, forgotten = self._recent.popleft()
            self._bytes -= len(forgotten.frame.data or b"")

    def _open(self, path: Path) -> None:
        """Opens a clip and writes the results before it and the current one."""
        video = self._files.enter_context(video_sink(path, self._fps))
        lines = self._files.enter_context(json_lines_sink(path.with_suffix(".jsonl")))
        self._sinks = [sink for sink in (video, lines) if sink is not None]
        self.paths.append(path)
        for _, result in self._recent:
            for sink in self._sinks:
                sink.write_result(result)


@contextmanager
def departure_clips(folder: Path, seconds: float | None, fps: float) -> Iterator[DepartureClips | None]:
    """Opens a sink for clips in `folder`; `fps` is the frame rate of frames without a time. None if `seconds` is None.

    The first clip creates the folder. Raises SourceError if the folder or a clip can't be written.
    """
    if seconds is None:
        yield None
        return
    # The first departure may come hours later.
    try:
        existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        with TemporaryFile(dir=existing):
            pass
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise SourceError(f"can't write to the folder {folder}: {reason}", "give another --departures-folder") from None
    with ExitStack() as files:
        yield DepartureClips(folder, seconds, fps, files)
