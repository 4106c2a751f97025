"""Reading a live source at its own pace: whoever is slower gets the newest frame, never an old one."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Self

from lanestream_client.frames import SourceFrame


class NewestFrames:
    """Iterates over `frames` from a thread that reads them all, so that each step gives the newest not yet given.

    `skipped` counts those that a newer one replaced. Raises what `frames` raises, in its turn.
    """

    def __init__(self, frames: Iterator[SourceFrame]) -> None:
        self._frames = frames
        self._changed = threading.Condition()
        self._newest: SourceFrame | None = None
        self._failure: Exception | None = None
        self._over = False
        self._stopped = False
        self._thread = threading.Thread(target=self._read, name="lanestream-source", daemon=True)
        self.skipped = 0

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        with self._changed:
            self._stopped = True
        self._thread.join()

    def __iter__(self) -> Iterator[SourceFrame]:
        return self

    def __next__(self) -> SourceFrame:
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not None or self._over)
            frame, self._newest = self._newest, None
            if frame is not None:
                return frame
            if self._failure is not None:
                raise self._failure
            raise StopIteration

    def _read(self) -> None:
        try:
            for frame in self._frames:
                with self._changed:
                    if self._stopped:
                        return
                    self.skipped += self._newest is not None
                    self._newest = frame
                    self._changed.notify()
        except Exception as error:
            self._failure = error
        finally:
            with self._changed:
                self._over = True
                self._changed.notify()
