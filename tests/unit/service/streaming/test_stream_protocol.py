"""The rules of a stream as plain calls: numbering, mailbox, credits, the end, the count. Time is a number."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.errors import IdleError, OverrunError, ProtocolError, TooOldError
from lanestream.protocol import FrameMessage, Mode, StartMessage
from lanestream.streaming.stream_protocol import IncomingFrame, Outcome, StreamLimits, StreamProtocol, check_age


def opened(mode: Mode, most: int = 3) -> StreamProtocol:
    rules = StreamProtocol(StreamLimits(credits=most), now=100.0)
    rules.start(StartMessage(mode=mode), 100.0)
    return rules


def next_seq(rules: StreamProtocol) -> int | None:
    frame = rules.take()
    return None if frame is None else frame.seq


def counts(rules: StreamProtocol) -> tuple[int, int, int, int]:
    summary = rules.summary(101.0)
    return summary.frames, summary.answered, summary.failed, summary.dropped


def test_a_first_frame_opens_the_stream_with_the_defaults() -> None:
    rules = StreamProtocol(StreamLimits(), now=100.0)
    assert not rules.is_open
    rules.receive(b"x", 100.5)
    assert rules.is_open
    assert rules.mode == "latest"
    with pytest.raises(ProtocolError, match="open already"):
        rules.start(StartMessage(), 101.0)


def test_frames_are_numbered_and_timed_where_the_client_does_not() -> None:
    rules = opened("all")
    rules.receive(b"a", 100.5)
    rules.announce(FrameMessage(seq=41, timestamp=-7.0), 100.5)
    rules.announce(FrameMessage(seq=42), 100.6)
    rules.receive(b"b", 100.6)
    rules.receive(b"c", 100.75)
    taken = []
    for _ in range(3):
        frame = rules.take()
        assert frame is not None
        taken.append((frame.seq, round(frame.timestamp, 3), frame.data, frame.arrived))
        rules.settle(Outcome.ANSWERED, 102.0)
    assert taken == [(0, 0.5, b"a", 100.5), (42, 0.6, b"b", 100.6), (43, 0.75, b"c", 100.75)]


def test_one_frame_is_worked_on_at_a_time() -> None:
    rules = opened("all")
    rules.receive(b"a", 101.0)
    rules.receive(b"b", 101.0)
    assert next_seq(rules) == 0
    assert next_seq(rules) is None
    rules.settle(Outcome.ANSWERED, 102.0)
    assert next_seq(rules) == 1


def test_latest_keeps_the_newest_waiting_frame() -> None:
    rules = opened("latest")
    rules.receive(b"a", 101.0)
    assert next_seq(rules) == 0
    for _ in range(4):
        rules.receive(b"b", 101.0)
    assert rules.dropped == 3
    rules.settle(Outcome.ANSWERED, 102.0)
    assert next_seq(rules) == 4
    rules.settle(Outcome.FAILED, 102.0)
    assert counts(rules) == (5, 1, 1, 3)


def test_a_frame_whose_turn_has_come_is_not_replaced() -> None:
    rules = opened("latest")
    rules.receive(b"a", 101.0)
    rules.receive(b"b", 101.0)
    assert rules.dropped == 0
    rules.receive(b"c", 101.0)
    assert rules.dropped == 1
    assert next_seq(rules) == 0
    rules.settle(Outcome.ANSWERED, 102.0)
    assert next_seq(rules) == 2


def test_a_frame_that_waits_for_frames_of_others_is_replaced() -> None:
    rules = opened("latest")
    rules.receive(b"a", 101.0)
    rules.queue(True)
    rules.receive(b"b", 101.1)
    rules.receive(b"c", 101.2)
    rules.queue(False)
    rules.receive(b"d", 101.3)
    assert next_seq(rules) == 2
    rules.settle(Outcome.ANSWERED, 102.0)
    assert next_seq(rules) == 3
    assert rules.dropped == 2


def test_all_grants_credits_and_an_answer_renews_one() -> None:
    rules = opened("all", most=2)
    rules.receive(b"a", 101.0)
    rules.receive(b"b", 101.0)
    with pytest.raises(OverrunError, match="2 frames are unanswered") as caught:
        rules.receive(b"c", 101.0)
    assert "grants 2" in caught.value.hint
    rules.take()
    with pytest.raises(OverrunError):
        rules.receive(b"c", 101.0)
    rules.settle(Outcome.FAILED, 102.0)
    rules.receive(b"c", 101.0)
    assert counts(rules) == (3, 0, 1, 0)


def test_the_end_waits_for_what_is_held() -> None:
    rules = opened("all")
    rules.receive(b"a", 101.0)
    rules.end(101.0)
    assert not rules.finished
    rules.take()
    assert not rules.finished
    rules.settle(Outcome.ANSWERED, 102.0)
    assert rules.finished
    assert rules.summary(103.25).duration_s == 3.25


def test_nothing_may_follow_the_end() -> None:
    rules = StreamProtocol(StreamLimits(), now=0.0)
    rules.end(101.0)
    assert rules.finished
    for late in (
        lambda: rules.end(1.0),
        lambda: rules.receive(b"x", 1.0),
        lambda: rules.announce(FrameMessage(), 1.0),
        lambda: rules.start(StartMessage(), 101.0),
    ):
        with pytest.raises(ProtocolError, match="after `end`"):
            late()
    assert counts(rules) == (0, 0, 0, 0)


class Driver:
    """Does what clients, the clock and the service do to a stream, in any order, and keeps its own account of it."""

    def __init__(self, mode: Mode, frames_per_s: float) -> None:
        self.rules = StreamProtocol(StreamLimits(credits=4, frames_per_s=frames_per_s, burst_s=1.0), now=100.0)
        self.rules.start(StartMessage(mode=mode), 100.0)
        self.now = 100.0
        self.received = self.expired = 0
        self.taken: list[IncomingFrame] = []
        self.busy = self.draining = False

    def do(self, step: str) -> None:
        self.now += 0.01
        if step == "r":
            with suppress(OverrunError, ProtocolError):
                self.rules.receive(b"x", self.now)
                self.received += not self.rules.over
        elif step == "e":
            with suppress(ProtocolError):
                self.rules.end(self.now)
        elif step == "d":
            self.draining = True
            self.rules.drain()
        elif step == "t":
            self.take()
        elif self.busy:
            self.settle({"s": Outcome.ANSWERED, "f": Outcome.FAILED, "x": Outcome.EXPIRED}[step])

    def take(self) -> None:
        frame = self.rules.take()
        assert frame is None or not self.busy, "one frame is worked on at a time"
        if frame is not None:
            self.taken.append(frame)
            self.busy = True

    def settle(self, outcome: Outcome) -> None:
        if self.taken[-1].refusal is not None:
            outcome = Outcome.FAILED
        self.expired += outcome is Outcome.EXPIRED
        self.rules.settle(outcome, self.now)
        self.busy = False

    def finish(self) -> None:
        """What a service does at the end of a stream, which its client or its own end brings about."""
        if not self.draining:
            self.do("e")
        while not self.rules.finished:
            self.take()
            self.settle(Outcome.ANSWERED)
        self.taken += self.rules.rest()


@given(
    mode=st.sampled_from(["latest", "all"]),
    frames_per_s=st.sampled_from([3.0, 1000.0]),
    steps=st.text("rrrrtttsssfxde", max_size=80),
)
def test_every_frame_is_answered_failed_or_dropped(mode: Mode, frames_per_s: float, steps: str) -> None:
    driver = Driver(mode, frames_per_s)
    for step in steps:
        driver.do(step)
    driver.finish()
    frames, answered, failed, dropped = counts(driver.rules)
    order = [frame.seq for frame in driver.taken]
    assert driver.rules.finished
    assert frames == driver.received == answered + failed + dropped
    assert order == sorted(set(order))
    assert len(order) == frames - (dropped - driver.expired), "all of them had their turn but those that were replaced"
    assert mode == "latest" or dropped == driver.expired
    assert all((frame.data == b"") == (frame.refusal is not None) for frame in driver.taken)


def refused(rules: StreamProtocol) -> str | None:
    """The code that the next frame is refused with; None where it is taken."""
    frame = rules.take()
    assert frame is not None
    rules.settle(Outcome.FAILED, 102.0)
    assert (frame.data == b"") == (frame.refusal is not None), "of a refused frame nothing is kept"
    return None if frame.refusal is None else frame.refusal.code


def limited(mode: Mode, **limits: float) -> StreamProtocol:
    rules = StreamProtocol(StreamLimits(burst_s=1.0, **limits), now=100.0)  # type: ignore[arg-type]
    rules.start(StartMessage(mode=mode), 100.0)
    return rules


def test_too_many_frames_a_second_are_refused_one_by_one_and_in_order() -> None:
    rules = limited("all", frames_per_s=3.0)
    for _ in range(5):
        rules.receive(b"x", 100.0)
    assert [refused(rules) for _ in range(5)] == [None] * 3 + ["too_fast"] * 2
    rules.receive(b"x", 100.4)
    assert refused(rules) is None


def test_too_many_bytes_a_second_are_refused() -> None:
    rules = limited("all", bytes_per_s=100.0)
    for size in (60, 30, 30):
        rules.receive(bytes(size), 100.0)
    assert [refused(rules) for _ in range(3)] == [None, None, "too_fast"]
    rules.receive(bytes(5000), 101.0)
    assert refused(rules) is None, "one image that is larger than a burst needs a full bucket, no more"
    rules.receive(bytes(1), 102.0)
    assert refused(rules) == "too_fast", "and is paid for"


def test_a_refused_frame_takes_no_waiting_frames_place() -> None:
    rules = limited("latest", frames_per_s=2.0)
    for _ in range(40):
        rules.receive(b"x", 100.0)
    assert [refused(rules) for _ in range(2)] == [None, None]
    assert refused(rules) == "too_fast"
    assert rules.take() is None, "of refused frames the newest one is told, the others count as dropped"
    assert counts(rules) == (40, 0, 3, 37)


def test_only_latest_frames_expire() -> None:
    for mode, deadline in (("latest", 103.5), ("all", None)):
        rules = StreamProtocol(StreamLimits(frame_deadline_s=2.5), now=100.0)
        rules.start(StartMessage(mode=mode), 100.0)  # type: ignore[arg-type]
        rules.receive(b"x", 101.0)
        frame = rules.take()
        assert frame is not None
        assert frame.deadline == deadline
    rules.settle(Outcome.EXPIRED, 102.0)
    assert counts(rules) == (1, 0, 0, 1)


def test_draining_answers_what_came_before_and_refuses_what_comes_after() -> None:
    rules = opened("all")
    rules.receive(b"a", 101.0)
    rules.take()
    rules.receive(b"b", 101.0)
    rules.drain()
    rules.receive(b"c", 101.0)
    assert not rules.finished
    rules.settle(Outcome.ANSWERED, 101.0)
    assert not rules.finished
    assert refused(rules) is None
    assert rules.finished
    assert not rules.ended
    assert [frame.refusal.code for frame in rules.rest() if frame.refusal] == ["draining"]
    rules.receive(b"d", 101.0)
    assert counts(rules) == (3, 1, 2, 0)


def test_a_resumed_stream_counts_on() -> None:
    rules = opened("all")
    rules.go_on(41, 7.0, 100.0)
    rules.receive(b"a", 100.5)
    frame = rules.take()
    assert frame is not None
    assert (frame.seq, frame.timestamp) == (42, 7.5)


def test_silence_is_counted_from_the_last_word_or_answer() -> None:
    rules = StreamProtocol(StreamLimits(handshake_s=5.0, idle_s=30.0), now=100.0)
    rules.check_silence(104.9)
    with pytest.raises(IdleError, match="5 seconds"):
        rules.check_silence(105.0)
    rules.start(StartMessage(), 104.0)
    rules.check_silence(133.9)
    rules.receive(b"x", 120.0)
    rules.check_silence(500.0)
    rules.take()
    rules.check_silence(500.0)
    rules.settle(Outcome.ANSWERED, 600.0)
    assert rules.silence_left(601.0) == pytest.approx(29.0)
    with pytest.raises(IdleError, match="30 seconds"):
        rules.check_silence(630.0)


def test_a_session_has_a_longest_life() -> None:
    check_age(9.9, 10.0)
    with pytest.raises(TooOldError, match="10 seconds old"):
        check_age(10.0, 10.0)
