"""The client's side of a stream as plain calls."""

from __future__ import annotations

import json

import fakes
import pytest
from websockets.exceptions import ConnectionClosedError
from websockets.frames import Close

from lanestream.errors import (
    BusyError,
    ConnectionFailedError,
    ImageTooLargeError,
    LanestreamError,
    OverrunError,
    ProtocolError,
)
from lanestream.protocol import (
    EgoModel,
    ErrorMessage,
    LanesMessage,
    Mode,
    SummaryMessage,
    TimingModel,
)
from lanestream_client.conversation import Conversation, lost
from lanestream_client.frames import SourceFrame

READY = fakes.ready(limits=fakes.limits(max_bytes=10, credits=8))
SUMMARY = SummaryMessage(frames=3, answered=3, failed=0, dropped=0, duration_s=1.0)


def opened(mode: Mode = "all", most: int = 8) -> Conversation:
    conversation = Conversation(mode, in_flight=2)
    limits = READY.limits.model_copy(update={"credits": most})
    conversation.opened(READY.model_copy(update={"limits": limits}).model_dump_json())
    return conversation


def lanes(seq: int) -> str:
    timing = TimingModel(decode=0, propose=0, queue=0, infer=0, track=0, total=0)
    ego = EgoModel(left=None, right=None, offset=None)
    message = LanesMessage(
        seq=seq, timestamp=0, width=9, height=9, horizon=1, lanes=[], ego=ego, events=[], dropped=0, timing_ms=timing
    )
    return message.model_dump_json()


def error(code: str, seq: int | None = None, *, fatal: bool = False) -> str:
    return ErrorMessage(code=code, message="m", hint="h", seq=seq, fatal=fatal).model_dump_json()


def send(conversation: Conversation, seq: int, data: bytes = b"x") -> list[str | bytes]:
    return conversation.outgoing(SourceFrame(seq, 0.5 * seq, data=data), data)


def test_the_opening_says_what_was_asked_for() -> None:
    assert json.loads(Conversation("all").opening()) == {"type": "start", "mode": "all"}
    asked = {"type": "start", "mode": "latest", "horizon": 0.4, "detector": "regression"}
    assert json.loads(Conversation("latest", 0.4, "regression").opening()) == asked


def test_an_opening_that_no_service_would_take_is_told() -> None:
    for conversation in (Conversation("all", 7.0), Conversation("all", detector="guesses")):  # type: ignore[arg-type]
        with pytest.raises(ProtocolError, match=r"horizon: .* less than 1|detector: .* 'candidates' or 'regression'"):
            conversation.opening()


def test_a_frame_is_its_number_and_time_and_its_bytes() -> None:
    conversation = opened()
    text, data = send(conversation, 3)
    assert json.loads(text) == {"type": "frame", "seq": 3, "timestamp": 1.5}
    assert data == b"x"
    text, _ = conversation.outgoing(SourceFrame(4, None, data=b"x"), b"x")
    assert json.loads(text) == {"type": "frame", "seq": 4}


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_two_frames_are_in_flight_and_an_answer_makes_room(mode: Mode) -> None:
    conversation = opened(mode)
    send(conversation, 0)
    assert conversation.has_room
    send(conversation, 1)
    assert not conversation.has_room
    with pytest.raises(OverrunError):
        send(conversation, 2)
    (result,) = conversation.incoming(lanes(0))
    assert result.frame.seq == 0
    assert result.lanes is not None
    assert conversation.has_room


def test_no_more_is_sent_than_is_granted() -> None:
    conversation = opened(most=1)
    send(conversation, 0)
    assert not conversation.has_room


def test_frames_without_an_answer_before_an_answered_one_were_dropped() -> None:
    conversation = opened("latest")
    send(conversation, 0)
    send(conversation, 1)
    assert [result.frame.seq for result in conversation.incoming(lanes(1))] == [1]
    assert conversation.has_room


def test_a_frame_with_too_many_bytes_is_refused_here_and_told_in_its_turn() -> None:
    conversation = opened()
    send(conversation, 0)
    assert send(conversation, 1, bytes(11)) == []
    assert conversation.has_room
    assert [result.frame.seq for result in conversation.incoming(lanes(0))] == [0]
    send(conversation, 2)
    refused, answered = conversation.incoming(lanes(2))
    assert refused.error is not None
    assert refused.error.code == "image_too_large"
    assert answered.frame.seq == 2
    send(conversation, 3, bytes(11))
    (last,) = conversation.incoming(SUMMARY.model_dump_json())
    assert last.frame.seq == 3
    assert conversation.summary == SUMMARY


def test_an_error_of_a_frame_is_its_result() -> None:
    conversation = opened()
    send(conversation, 0)
    (result,) = conversation.incoming(error("bad_image", 0))
    assert result.lanes is None
    assert result.error is not None
    assert result.error.code == "bad_image"


def test_other_errors_are_raised_as_what_they_are() -> None:
    with pytest.raises(BusyError, match=r"m \(h\)"):
        Conversation("all").opened(error("busy", fatal=True))
    with pytest.raises(OverrunError):
        opened().incoming(error("overrun", fatal=True))
    with pytest.raises(LanestreamError) as caught:
        opened().incoming(error("something of tomorrow", fatal=True))
    assert type(caught.value) is LanestreamError


@pytest.mark.parametrize("text", [b"bytes", "no json", "{}", '{"type": "lanes"}', READY.model_dump_json(), lanes(7)])
def test_what_is_no_answer_is_told(text: str | bytes) -> None:
    with pytest.raises(ProtocolError):
        opened().incoming(text)
    if not (isinstance(text, str) and '"ready"' in text):
        with pytest.raises(ProtocolError):
            Conversation("all").opened(text)


def test_a_lost_connection_says_why() -> None:
    assert isinstance(lost(ConnectionClosedError(Close(1009, ""), None)), ImageTooLargeError)
    assert (
        str(lost(ConnectionClosedError(Close(1011, "oops"), None)))
        == "the service closed the stream with code 1011: oops"
    )
    broken = lost(ConnectionClosedError(None, None))
    assert isinstance(broken, ConnectionFailedError)
    assert "broke" in str(broken)
