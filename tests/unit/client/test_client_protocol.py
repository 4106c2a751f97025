"""The client's side of a stream as plain calls."""

from __future__ import annotations

import json
from typing import Any

import fakes
import pytest

from lanestream.errors import BusyError, DrainingError, LanestreamError, OverrunError, ProtocolError
from lanestream.protocol import (
    DrainingMessage,
    ErrorMessage,
    Mode,
    StartMessage,
    SummaryMessage,
)
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary

SUMMARY = SummaryMessage(frames=3, answered=3, failed=0, dropped=0, duration_s=1.0).model_dump_json()


def ready(*, last_seq: int | None = None, resumed: bool = False, again: str = "secret", **limits: Any) -> str:
    usual = {"max_bytes": 10, "credits": 8}
    message = fakes.ready(
        resumed=resumed, last_seq=last_seq, resume_token=again, limits=fakes.limits(**{**usual, **limits})
    )
    return message.model_dump_json()


def opened(mode: Mode = "all", in_flight: int = 2, **limits: Any) -> ClientProtocol:
    clock = iter((5.0, 7.25))
    conversation = ClientProtocol(StartMessage(mode=mode), in_flight=in_flight, clock=lambda: next(clock))
    assert conversation.opened(ready(**limits)) == []
    return conversation


def lanes(seq: int) -> str:
    return fakes.lanes(seq).model_dump_json()


def error(code: str, seq: int | None = None, *, fatal: bool = False) -> str:
    return ErrorMessage(code=code, message="m", hint="h", seq=seq, fatal=fatal).model_dump_json()


def draining(again: str | None = "secret") -> str:
    return DrainingMessage(resume_token=again, deadline_s=5.0).model_dump_json()


def offer(conversation: ClientProtocol, seq: int, data: bytes = b"x") -> None:
    conversation.offer(SourceFrame(seq, 0.5 * seq, data=data), data)


def sent(conversation: ClientProtocol) -> list[int | str]:
    """What is sent now: the numbers of frames, perhaps `end`."""
    what: list[int | str] = []
    while messages := conversation.outgoing():
        message = json.loads(messages[0])
        what.append(message.get("seq", message["type"]))
    return what


def send(conversation: ClientProtocol, *numbers: int) -> None:
    for seq in numbers:
        offer(conversation, seq)
        assert sent(conversation) == [seq]


def told(results: list[StreamResult]) -> list[tuple[int, str]]:
    """Each result as its frame's number and its error's code, or `lanes`."""
    return [(result.frame.seq, result.error.code if result.error else "lanes") for result in results]


def counts(conversation: ClientProtocol) -> tuple[int, int, int, int, int]:
    total = conversation.summary
    assert total is not None
    assert total.frames == total.answered + total.failed + total.dropped + total.lost
    return total.frames, total.answered, total.failed, total.dropped, total.lost


def test_a_frame_is_its_number_and_time_and_its_bytes() -> None:
    conversation = opened()
    offer(conversation, 3)
    text, data = conversation.outgoing()
    assert json.loads(text) == {"type": "frame", "seq": 3, "timestamp": 1.5}
    assert data == b"x"
    conversation.offer(SourceFrame(4, None, data=b"x"), b"x")
    text, _ = conversation.outgoing()
    assert json.loads(text) == {"type": "frame", "seq": 4}


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_two_frames_are_in_flight_and_an_answer_makes_room(mode: Mode) -> None:
    conversation = opened(mode)
    send(conversation, 0, 1)
    assert conversation.wants_frame
    offer(conversation, 2)
    assert not conversation.wants_frame
    assert sent(conversation) == []
    assert told(conversation.incoming(lanes(0))) == [(0, "lanes")]
    assert sent(conversation) == [2]
    assert conversation.wants_frame


def test_no_more_is_sent_than_is_granted() -> None:
    conversation = opened(credits=1)
    send(conversation, 0)
    offer(conversation, 1)
    assert sent(conversation) == []


def test_numbers_must_rise() -> None:
    conversation = opened()
    send(conversation, 1)
    with pytest.raises(ProtocolError, match="frame 1 came after frame 1"):
        offer(conversation, 1)


def test_the_end_is_sent_once_after_the_last_frame() -> None:
    conversation = opened(in_flight=1)
    send(conversation, 0)
    offer(conversation, 1)
    conversation.no_more()
    assert conversation.outgoing() == []
    conversation.incoming(lanes(0))
    assert sent(conversation) == [1, "end"]
    conversation.incoming(lanes(1))
    assert conversation.incoming(SUMMARY) == []
    assert conversation.summary == StreamSummary(frames=2, answered=2, failed=0, dropped=0, lost=0, duration_s=2.25), (
        "counted here, over all connections"
    )


def test_frames_without_an_answer_before_an_answered_one_were_dropped() -> None:
    conversation = opened("latest", in_flight=3)
    send(conversation, 0, 1, 2)
    assert told(conversation.incoming(lanes(1))) == [(1, "lanes")]
    conversation.no_more()
    assert sent(conversation) == ["end"]
    assert conversation.incoming(SUMMARY) == []
    assert counts(conversation) == (3, 1, 0, 2, 0)


def test_where_none_may_be_dropped_a_frame_without_an_answer_is_told() -> None:
    conversation = opened("all", in_flight=3)
    send(conversation, 0, 1, 2)
    assert told(conversation.incoming(lanes(1))) == [(0, "lost"), (1, "lanes")]
    conversation.no_more()
    conversation.outgoing()
    assert told(conversation.incoming(SUMMARY)) == [(2, "lost")]


def test_a_frame_with_too_many_bytes_is_refused_here_and_told_in_its_turn() -> None:
    conversation = opened()
    send(conversation, 0)
    offer(conversation, 1, bytes(11))
    assert conversation.wants_frame
    assert sent(conversation) == []
    assert told(conversation.incoming(lanes(0))) == [(0, "lanes")]
    send(conversation, 2)
    assert told(conversation.incoming(lanes(2))) == [(1, "image_too_large"), (2, "lanes")]
    offer(conversation, 3, bytes(11))
    conversation.no_more()
    assert sent(conversation) == ["end"]
    assert told(conversation.incoming(SUMMARY)) == [(3, "image_too_large")]
    assert counts(conversation) == (4, 2, 2, 0, 0)


@pytest.mark.parametrize("code", ["bad_image", "too_fast", "expired", "image_too_large", "internal"])
def test_an_error_of_a_frame_is_its_result(code: str) -> None:
    conversation = opened()
    send(conversation, 0)
    assert told(conversation.incoming(error(code, 0))) == [(0, code)]


def test_other_errors_are_raised_as_what_they_are() -> None:
    fresh = ClientProtocol(StartMessage())
    with pytest.raises(BusyError, match=r"m \(h\)"):
        fresh.opened(error("busy", fatal=True))
    with pytest.raises(DrainingError):
        fresh.opened(draining())
    with pytest.raises(OverrunError):
        opened().incoming(error("overrun", fatal=True))
    with pytest.raises(LanestreamError) as caught:
        opened().incoming(error("something of tomorrow", fatal=True))
    assert type(caught.value) is LanestreamError


ODD = [b"bytes", "no json", "{}", '{"type": "lanes"}', ready(), lanes(7), error("draining", 7), SUMMARY]


@pytest.mark.parametrize("text", ODD)
def test_what_is_no_answer_is_told(text: str | bytes) -> None:
    with pytest.raises(ProtocolError):
        opened().incoming(text)


@pytest.mark.parametrize("text", [b"bytes", "no json", lanes(7), SUMMARY])
def test_what_is_no_answer_to_the_opening_is_told(text: str | bytes) -> None:
    with pytest.raises(ProtocolError):
        ClientProtocol(StartMessage()).opened(text)


def test_each_opening_has_the_latest_token() -> None:
    conversation = ClientProtocol(StartMessage(mode="all", session="cam-7"))
    first = {"type": "start", "mode": "all", "session": "cam-7"}
    assert json.loads(conversation.opening()) == first
    conversation.opened(ready(again="one"))
    assert json.loads(conversation.opening()) == {**first, "resume_token": "one"}
    conversation.incoming(draining("two"))
    assert json.loads(conversation.opening()) == {**first, "resume_token": "two"}
    conversation.lost_connection()
    conversation.opened(ready(again="three"))
    assert conversation.reconnects == 1
    conversation.incoming(draining(None))
    assert json.loads(conversation.opening()) == {**first, "resume_token": "three"}


def test_in_latest_what_was_sent_is_lost_with_the_connection_and_what_waits_is_not() -> None:
    conversation = opened("latest")
    send(conversation, 0, 1)
    offer(conversation, 2)
    assert told(conversation.lost_connection()) == [(0, "lost"), (1, "lost")]
    assert not conversation.wants_frame
    assert conversation.outgoing() == [], "there is no connection"
    assert conversation.opened(ready(resumed=True, last_seq=0)) == []
    assert sent(conversation) == [2]
    assert told(conversation.incoming(lanes(2))) == [(2, "lanes")]


def test_in_all_a_session_that_goes_on_gets_again_what_it_has_not_worked_on() -> None:
    conversation = opened(in_flight=4)
    send(conversation, 0, 1, 2, 3)
    assert told(conversation.incoming(lanes(0))) == [(0, "lanes")]
    assert conversation.lost_connection() == []
    assert told(conversation.opened(ready(resumed=True, last_seq=1))) == [(1, "lost")]
    assert sent(conversation) == [2, 3]
    assert told(conversation.incoming(lanes(2))) == [(2, "lanes")]


@pytest.mark.parametrize("answer", [{}, {"last_seq": 9}, {"resumed": True}])
def test_in_all_a_session_that_begins_afresh_gets_all_of_it_again(answer: dict[str, Any]) -> None:
    conversation = opened(in_flight=3)
    send(conversation, 4, 5, 6)
    assert conversation.lost_connection() == []
    assert conversation.opened(ready(**answer)) == []
    assert sent(conversation) == [4, 5, 6]


def test_what_is_sent_again_is_held_to_the_new_limits() -> None:
    conversation = opened(in_flight=3)
    for seq, size in ((0, 1), (1, 9), (2, 1)):
        offer(conversation, seq, bytes(size))
        assert sent(conversation) == [seq]
    conversation.lost_connection()
    conversation.opened(ready(credits=1, max_bytes=5))
    assert sent(conversation) == [0]
    assert told(conversation.incoming(lanes(0))) == [(0, "lanes")]
    assert sent(conversation) == [2]
    assert told(conversation.incoming(lanes(2))) == [(1, "image_too_large"), (2, "lanes")]


def test_a_connection_that_is_lost_twice_loses_and_repeats_nothing_more() -> None:
    conversation = opened(in_flight=3)
    send(conversation, 0, 1, 2)
    conversation.lost_connection()
    assert conversation.lost_connection() == [], "as where no replica could be reached"
    assert told(conversation.opened(ready(resumed=True, last_seq=0))) == [(0, "lost")]
    assert conversation.lost_connection() == []
    assert conversation.opened(ready(resumed=True, last_seq=0)) == []
    assert sent(conversation) == [1, 2]


def test_the_end_is_sent_again() -> None:
    conversation = opened()
    send(conversation, 0)
    conversation.no_more()
    assert sent(conversation) == ["end"]
    assert conversation.lost_connection() == []
    assert conversation.summary is None
    conversation.opened(ready())
    assert sent(conversation) == [0, "end"]
    conversation.incoming(lanes(0))
    conversation.incoming(SUMMARY)
    assert counts(conversation) == (1, 1, 0, 0, 0)


@pytest.mark.parametrize(("mode", "answered"), [("latest", False), ("latest", True), ("all", True)])
def test_nobody_has_to_reconnect_for_the_summary_alone(mode: Mode, answered: bool) -> None:
    conversation = opened(mode)
    send(conversation, 0)
    conversation.no_more()
    if answered:
        conversation.incoming(lanes(0))
    assert told(conversation.lost_connection()) == ([] if answered else [(0, "lost")])
    assert counts(conversation) == (1, int(answered), 0, 0, int(not answered))


@pytest.mark.parametrize(("mode", "lost"), [("latest", [(0, "lost"), (1, "image_too_large")]), ("all", [])])
def test_a_frame_refused_here_survives_a_lost_connection(mode: Mode, lost: list[tuple[int, str]]) -> None:
    conversation = opened(mode)
    send(conversation, 0)
    offer(conversation, 1, bytes(11))
    offer(conversation, 2)
    assert told(conversation.lost_connection()) == lost
    conversation.opened(ready())
    assert sent(conversation) == ([2] if lost else [0, 2])
    results = [result for seq in ([2] if lost else [0, 2]) for result in conversation.incoming(lanes(seq))]
    assert told(results) == ([(2, "lanes")] if lost else [(0, "lanes"), (1, "image_too_large"), (2, "lanes")])


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_a_service_that_stops_gets_nothing_more_and_its_answers_count(mode: Mode) -> None:
    conversation = opened(mode)
    send(conversation, 0)
    assert conversation.incoming(draining()) == []
    assert conversation.is_draining
    offer(conversation, 1)
    assert conversation.outgoing() == []
    assert told(conversation.incoming(lanes(0))) == [(0, "lanes")]
    assert conversation.lost_connection() == []
    assert conversation.opened(ready(resumed=True, last_seq=0)) == []
    assert not conversation.is_draining
    assert sent(conversation) == [1]


def test_in_all_frames_that_came_too_late_are_sent_to_the_next() -> None:
    conversation = opened(in_flight=4)
    send(conversation, 0, 1, 2, 3)
    conversation.incoming(draining())
    assert told(conversation.incoming(lanes(0))) == [(0, "lanes")]
    assert conversation.incoming(error("draining", 1)) == []
    assert conversation.incoming(error("draining", 2)) == []
    assert conversation.lost_connection() == []
    assert conversation.opened(ready(resumed=True, last_seq=0)) == []
    assert sent(conversation) == [1, 2, 3]


def test_in_latest_frames_that_came_too_late_are_lost() -> None:
    conversation = opened("latest", in_flight=3)
    send(conversation, 0, 1, 2)
    conversation.incoming(draining())
    assert told(conversation.incoming(error("draining", 1))) == [(1, "lost")]
    assert told(conversation.lost_connection()) == [(2, "lost")]
    conversation.no_more()
    assert told(conversation.given_up()) == []
    assert counts(conversation) == (3, 0, 0, 1, 2)


def test_a_frame_that_was_asked_for_before_others_have_to_be_sent_again_waits_behind_them() -> None:
    conversation = opened(in_flight=2)
    send(conversation, 0)
    conversation.lost_connection()
    conversation.opened(ready())
    offer(conversation, 1)
    assert sent(conversation) == [0, 1]


def test_an_answer_before_a_frame_that_has_to_be_sent_again_is_out_of_order() -> None:
    conversation = opened()
    send(conversation, 0, 1)
    conversation.incoming(error("draining", 0))
    with pytest.raises(ProtocolError, match="answered frame 1 before"):
        conversation.incoming(lanes(1))


def test_a_source_that_ends_while_there_is_no_connection_ends_the_stream_over_the_next() -> None:
    conversation = opened()
    send(conversation, 0)
    conversation.incoming(lanes(0))
    assert conversation.lost_connection() == []
    assert conversation.summary is None, "more frames may come"
    conversation.no_more()
    conversation.opened(ready(resumed=True, last_seq=0))
    assert sent(conversation) == ["end"]


def test_who_gives_up_tells_of_every_frame() -> None:
    conversation = opened(in_flight=1)
    send(conversation, 0)
    offer(conversation, 1)
    conversation.lost_connection()
    assert told(conversation.given_up()) == [(0, "lost"), (1, "lost")]
    assert counts(conversation) == (2, 0, 0, 0, 2)
    never = ClientProtocol(StartMessage())
    assert never.given_up() == []
    assert counts(never) == (0, 0, 0, 0, 0)
