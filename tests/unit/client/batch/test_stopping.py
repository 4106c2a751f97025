"""The signals that stop a batch."""

from __future__ import annotations

import os
import signal

import pytest

from lanestream_client.batch.stopping import stop_signals


def test_signals_are_noted() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with stop_signals() as stop:
        assert not stop.received.is_set()
        os.kill(os.getpid(), signal.SIGTERM)
        assert stop.received.is_set()
        assert stop.signal == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) == before


def test_ignored_signals_stay_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stop_signals() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.received.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)


def test_waits_are_interrupted_by_signals_that_come_and_have_come() -> None:
    with stop_signals() as stop:
        with pytest.raises(KeyboardInterrupt), stop.interrupting():
            os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt), stop.interrupting():
            pass
        os.kill(os.getpid(), signal.SIGINT)  # outside of such a wait
