"""The signals that stop a batch."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Event
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from types import FrameType

STOP_SIGNALS: Final = (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)


class StopSignals:
    """Notes Ctrl-C, SIGTERM and the end of the terminal, so that a batch stops between two steps."""

    def __init__(self) -> None:
        self.received = Event()
        self.signal: int | None = None
        self._interrupts = False

    @contextmanager
    def interrupting(self) -> Iterator[None]:
        """Raises KeyboardInterrupt in the block if a signal comes or has come: for waits that can't be ended else."""
        self._interrupts = True
        try:
            if self.received.is_set():
                raise KeyboardInterrupt
            yield
        finally:
            self._interrupts = False

    def note(self, number: int, _: FrameType | None) -> None:
        """Notes a signal; the handler of signals."""
        self.signal = number
        self.received.set()
        if self._interrupts:
            raise KeyboardInterrupt


@contextmanager
def stop_signals() -> Iterator[StopSignals]:
    """Notes signals during the block, instead of being ended by them. Ignored ones stay ignored, as `nohup` wants."""
    stop = StopSignals()
    heard = [number for number in STOP_SIGNALS if signal.getsignal(number) != signal.SIG_IGN]
    before = {number: signal.signal(number, stop.note) for number in heard}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
