"""The rules of a stream as plain calls: numbering, replacement, credits, the end, the counts. Time is a number."""

from __future__ import annotations

from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lanestream.errors import IdleError, OverrunError, ProtocolError
from lanestream.protocol import (
    WARNINGS,
    DrainingMessage,
    EndMessage,
    ErrorMessage,
    FrameMessage,
    Mode,
    StartMessage,
    WarningCode,
    WarningMessage,
)
from lanestream.streaming.stream_protocol import (
    FrameOutcome,
    IncomingFrame,
    StreamLimits,
    StreamProtocol,
    StreamState,
)
from lanestream.tracking.departure import VehicleMotion


def open_stream(mode: Mode, credit_limit: int = 3) -> StreamProtocol:
    protocol = StreamProtocol(StreamLimits(credits=credit_limit), now=100.0)
    protocol.receive_start(StartMessage(mode=mode), 100.0)
    return protocol


def next_seq(protocol: StreamProtocol) -> int | None:
    frame = protocol.take_frame()
    return None if frame is None else frame.seq


def counts(protocol: StreamProtocol) -> tuple[int, int, int, int]:
    summary = protocol.summary(101.0)
    return summary.frames, summary.answered, summary.failed, summary.dropped


def errors_to_send(protocol: StreamProtocol) -> list[ErrorMessage]:
    return [message for message in protocol.messages_to_send() if isinstance(message, ErrorMessage)]


def test_a_first_image_opens_the_stream_with_the_defaults() -> None:
    protocol = StreamProtocol(StreamLimits(), now=100.0)
    assert protocol.state is StreamState.CONNECTING
    protocol.receive_image(b"x", 100.5)
    assert protocol.state is StreamState.OPEN
    assert protocol.mode == "latest"
    with pytest.raises(ProtocolError, match="`start` came in a stream that is already open"):
        protocol.receive_start(StartMessage(), 101.0)


def test_missing_numbers_and_times_are_assigned() -> None:
    protocol = open_stream("all")
    protocol.receive_image(b"a", 100.5)
    protocol.receive_message(FrameMessage(seq=41, timestamp=-7.0), 100.5)
    protocol.receive_message(FrameMessage(seq=42), 100.6)
    protocol.receive_image(b"b", 100.6)
    protocol.receive_image(b"c", 100.75)
    taken = []
    for _ in range(3):
        frame = protocol.take_frame()
        assert frame is not None
        taken.append((frame.seq, round(frame.timestamp, 3), frame.data, frame.arrived))
        protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    assert taken == [(0, 0.5, b"a", 100.5), (42, 0.6, b"b", 100.6), (43, 0.75, b"c", 100.75)]


def test_a_frame_has_the_motion_that_was_announced_with_it() -> None:
    protocol = open_stream("all")
    protocol.receive_message(FrameMessage(speed=24.5, indicator="left"), 101.0)
    protocol.receive_image(b"a", 101.0)
    protocol.receive_image(b"b", 101.0)
    motions = []
    for _ in range(2):
        frame = protocol.take_frame()
        assert frame is not None
        motions.append(frame.motion)
        protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    assert motions == [VehicleMotion(24.5, "left"), VehicleMotion()]


@pytest.mark.parametrize("code", WARNINGS)
def test_a_warning_is_sent_with_its_text(code: WarningCode) -> None:
    protocol = open_stream("all")
    protocol.warn(code, 3)
    (message,) = protocol.messages_to_send()
    assert isinstance(message, WarningMessage)
    assert (message.code, message.message, message.hint, message.seq) == (code, *WARNINGS[code], 3)


def test_one_frame_is_processed_at_a_time() -> None:
    protocol = open_stream("all")
    protocol.receive_image(b"a", 101.0)
    protocol.receive_image(b"b", 101.0)
    assert next_seq(protocol) == 0
    assert next_seq(protocol) is None
    protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    assert next_seq(protocol) == 1


def test_latest_keeps_the_newest_waiting_frame() -> None:
    protocol = open_stream("latest")
    protocol.receive_image(b"a", 101.0)
    assert next_seq(protocol) == 0
    for _ in range(4):
        protocol.receive_image(b"b", 101.0)
    assert protocol.dropped == 3
    protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    assert next_seq(protocol) == 4
    protocol.complete_frame(FrameOutcome.FAILED, 102.0)
    assert counts(protocol) == (5, 1, 1, 3)


def test_a_frame_that_is_about_to_be_taken_is_not_replaced() -> None:
    protocol = open_stream("latest")
    protocol.receive_image(b"a", 101.0)
    protocol.receive_image(b"b", 101.0)
    assert protocol.dropped == 0
    protocol.receive_image(b"c", 101.0)
    assert protocol.dropped == 1
    assert next_seq(protocol) == 0
    protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    assert next_seq(protocol) == 2


def test_a_frame_that_waits_for_its_slot_is_replaced() -> None:
    protocol = open_stream("latest")
    protocol.receive_image(b"a", 101.0)
    protocol.request_slot()
    protocol.receive_image(b"b", 101.1)
    protocol.receive_image(b"c", 101.2)
    assert next_seq(protocol) == 2
    protocol.receive_image(b"d", 101.3)
    protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    protocol.receive_image(b"e", 102.1)
    assert next_seq(protocol) == 3, "without a request for a slot, a frame is about to be taken"
    assert protocol.dropped == 2


def test_all_limits_unanswered_frames_and_an_answer_renews_a_credit() -> None:
    protocol = open_stream("all", credit_limit=2)
    protocol.receive_image(b"a", 101.0)
    protocol.receive_image(b"b", 101.0)
    with pytest.raises(OverrunError, match="2 frames were unanswered") as caught:
        protocol.receive_image(b"c", 101.0)
    assert "allows 2" in caught.value.hint
    protocol.take_frame()
    with pytest.raises(OverrunError):
        protocol.receive_image(b"c", 101.0)
    protocol.complete_frame(FrameOutcome.FAILED, 102.0)
    protocol.receive_image(b"c", 101.0)
    assert counts(protocol) == (3, 0, 1, 0)


def test_the_end_waits_for_the_frames_held() -> None:
    protocol = open_stream("all")
    protocol.receive_image(b"a", 101.0)
    protocol.receive_message(EndMessage(), 101.0)
    assert not protocol.finished
    with pytest.raises(RuntimeError, match="expects a finished stream; this one is ending"):
        protocol.finish()
    protocol.take_frame()
    assert not protocol.finished
    protocol.complete_frame(FrameOutcome.ANSWERED, 102.0)
    assert protocol.finished
    assert protocol.summary(103.25).duration_s == 3.25


def test_nothing_may_follow_the_end() -> None:
    protocol = StreamProtocol(StreamLimits(), now=0.0)
    protocol.receive_message(EndMessage(), 101.0)
    assert protocol.finished
    for receive in (
        lambda: protocol.receive_message(EndMessage(), 1.0),
        lambda: protocol.receive_image(b"x", 1.0),
        lambda: protocol.receive_message(FrameMessage(), 1.0),
        lambda: protocol.receive_start(StartMessage(), 101.0),
    ):
        with pytest.raises(ProtocolError, match="after `end`"):
            receive()
    assert counts(protocol) == (0, 0, 0, 0)
    protocol.finish()
    assert protocol.state is StreamState.ENDED
    with pytest.raises(ProtocolError, match="an image came after `end`"):
        protocol.receive_image(b"x", 1.0)


class Driver:
    """Acts as the client, the clock and the service in any order, and counts the frames independently."""

    def __init__(self, mode: Mode, frames_per_s: float) -> None:
        limits = StreamLimits(credits=4, frames_per_s=frames_per_s, burst_s=1.0)
        self.protocol = StreamProtocol(limits, now=100.0)
        self.protocol.receive_start(StartMessage(mode=mode), 100.0)
        self.now = 100.0
        self.received = self.expired = 0
        self.taken: list[IncomingFrame] = []
        self.answered_late: list[int | None] = []
        self.busy = self.draining = False

    def do(self, step: str) -> None:
        self.now += 0.01
        if step == "r":
            with suppress(OverrunError, ProtocolError):
                self.protocol.receive_image(b"x", self.now)
                self.received += self.protocol.state is not StreamState.DRAINED
        elif step == "e":
            with suppress(ProtocolError):
                self.protocol.receive_message(EndMessage(), self.now)
        elif step == "d":
            self.draining = True
            self.protocol.drain("token", 10.0)
        elif step == "q":
            self.protocol.request_slot()
        elif step == "t":
            self.take()
        elif self.busy:
            outcomes = {"s": FrameOutcome.ANSWERED, "f": FrameOutcome.FAILED, "x": FrameOutcome.EXPIRED}
            self.complete(outcomes[step])

    def take(self) -> None:
        frame = self.protocol.take_frame()
        assert frame is None or not self.busy, "one frame is processed at a time"
        if frame is not None:
            self.taken.append(frame)
            self.busy = True

    def complete(self, outcome: FrameOutcome) -> None:
        if self.taken[-1].refusal is not None:
            outcome = FrameOutcome.FAILED
        self.expired += outcome is FrameOutcome.EXPIRED
        self.protocol.complete_frame(outcome, self.now)
        self.busy = False

    def finish(self) -> None:
        """Does what a service does at the end of a stream, whichever side ends it."""
        if not self.draining:
            self.do("e")
        while not self.protocol.finished:
            self.take()
            self.complete(FrameOutcome.ANSWERED)
        self.protocol.finish()
        self.answered_late = [error.seq for error in errors_to_send(self.protocol)]


@given(
    mode=st.sampled_from(["latest", "all"]),
    frames_per_s=st.sampled_from([3.0, 1000.0]),
    steps=st.text("rrrrtttqsssfxde", max_size=80),
)
def test_every_frame_is_answered_failed_or_dropped(mode: Mode, frames_per_s: float, steps: str) -> None:
    driver = Driver(mode, frames_per_s)
    for step in steps:
        driver.do(step)
    driver.finish()
    frames, answered, failed, dropped = counts(driver.protocol)
    order = [*(frame.seq for frame in driver.taken), *driver.answered_late]
    assert driver.protocol.finished
    assert frames == driver.received == answered + failed + dropped
    assert order == sorted(set(order))
    assert len(order) == frames - (dropped - driver.expired), "every frame that was not replaced was answered"
    assert mode == "latest" or dropped == driver.expired
    assert all((frame.data == b"") == (frame.refusal is not None) for frame in driver.taken)


def refusal_of_next(protocol: StreamProtocol) -> str | None:
    """Takes and completes the next frame. Returns the code of its refusal; None if it was accepted."""
    frame = protocol.take_frame()
    assert frame is not None
    protocol.complete_frame(FrameOutcome.FAILED, 102.0)
    assert (frame.data == b"") == (frame.refusal is not None), "the image of a refused frame is discarded"
    return None if frame.refusal is None else frame.refusal.code


def limited_stream(mode: Mode, **limits: float) -> StreamProtocol:
    protocol = StreamProtocol(StreamLimits(burst_s=1.0, **limits), now=100.0)  # type: ignore[arg-type]
    protocol.receive_start(StartMessage(mode=mode), 100.0)
    return protocol


def test_too_many_frames_per_second_are_refused_one_by_one_and_in_order() -> None:
    protocol = limited_stream("all", frames_per_s=3.0)
    for _ in range(5):
        protocol.receive_image(b"x", 100.0)
    assert [refusal_of_next(protocol) for _ in range(5)] == [None] * 3 + ["too_fast"] * 2
    protocol.receive_image(b"x", 100.4)
    assert refusal_of_next(protocol) is None


def test_too_many_bytes_per_second_are_refused() -> None:
    protocol = limited_stream("all", bytes_per_s=100.0)
    for size in (60, 30, 30):
        protocol.receive_image(bytes(size), 100.0)
    assert [refusal_of_next(protocol) for _ in range(3)] == [None, None, "too_fast"]
    protocol.receive_image(bytes(5000), 101.0)
    assert refusal_of_next(protocol) is None, "an image that is larger than a burst only needs a full bucket"
    protocol.receive_image(bytes(1), 102.0)
    assert refusal_of_next(protocol) == "too_fast", "and its full size is spent"


def test_a_refused_frame_does_not_replace_an_accepted_one() -> None:
    protocol = limited_stream("latest", frames_per_s=2.0)
    for _ in range(40):
        protocol.receive_image(b"x", 100.0)
    assert [refusal_of_next(protocol) for _ in range(2)] == [None, None]
    assert refusal_of_next(protocol) == "too_fast"
    assert protocol.take_frame() is None, "only the newest refused frame is answered; the others count as dropped"
    assert counts(protocol) == (40, 0, 3, 37)


def test_only_frames_in_mode_latest_expire() -> None:
    for mode, deadline in (("latest", 103.5), ("all", None)):
        protocol = StreamProtocol(StreamLimits(frame_deadline_s=2.5), now=100.0)
        protocol.receive_start(StartMessage(mode=mode), 100.0)  # type: ignore[arg-type]
        protocol.receive_image(b"x", 101.0)
        frame = protocol.take_frame()
        assert frame is not None
        assert frame.deadline == deadline
    protocol.complete_frame(FrameOutcome.EXPIRED, 102.0)
    assert counts(protocol) == (1, 0, 0, 1)


def test_draining_answers_earlier_frames_and_refuses_later_ones() -> None:
    protocol = open_stream("all")
    protocol.receive_image(b"a", 101.0)
    protocol.take_frame()
    protocol.receive_image(b"b", 101.0)
    protocol.drain("token", 10.0)
    assert protocol.messages_to_send() == [DrainingMessage(resume_token="token", deadline_s=10.0)]  # noqa: S106
    protocol.receive_image(b"c", 101.0)
    assert not protocol.finished
    protocol.complete_frame(FrameOutcome.ANSWERED, 101.0)
    assert not protocol.finished
    assert refusal_of_next(protocol) is None
    assert protocol.finished
    assert not protocol.ended_by_client
    protocol.finish()
    assert protocol.state is StreamState.DRAINED
    assert [(error.code, error.seq) for error in errors_to_send(protocol)] == [("draining", 2)]
    protocol.receive_image(b"d", 101.0)
    assert counts(protocol) == (3, 1, 2, 0)


def test_a_client_may_end_a_draining_stream() -> None:
    protocol = open_stream("all")
    protocol.drain(None, 10.0)
    protocol.receive_image(b"a", 101.0)
    protocol.receive_message(EndMessage(), 101.0)
    protocol.drain(None, 10.0)
    assert protocol.state is StreamState.ENDING
    assert refusal_of_next(protocol) == "draining"
    protocol.finish()
    assert protocol.state is StreamState.ENDED
    assert errors_to_send(protocol) == []


def test_a_resumed_stream_continues_its_numbers_and_its_clock() -> None:
    protocol = open_stream("all")
    protocol.resume(41, 7.0, 100.0)
    protocol.receive_image(b"a", 100.5)
    frame = protocol.take_frame()
    assert frame is not None
    assert (frame.seq, frame.timestamp) == (42, 7.5)


def test_idle_time_counts_from_the_last_message_or_answer() -> None:
    protocol = StreamProtocol(StreamLimits(handshake_s=5.0, idle_s=30.0), now=100.0)
    protocol.check_idle(104.9)
    with pytest.raises(IdleError, match="5 seconds"):
        protocol.check_idle(105.0)
    protocol.receive_start(StartMessage(), 104.0)
    protocol.check_idle(133.9)
    protocol.receive_image(b"x", 120.0)
    protocol.check_idle(500.0)
    protocol.take_frame()
    protocol.check_idle(500.0)
    protocol.complete_frame(FrameOutcome.ANSWERED, 600.0)
    assert protocol.idle_s_left(601.0) == pytest.approx(29.0)
    with pytest.raises(IdleError, match="30 seconds"):
        protocol.check_idle(630.0)
