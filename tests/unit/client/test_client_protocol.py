"""The client's side of a stream, without any I/O."""

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
    warning_message,
)
from lanestream_client.client_protocol import ClientProtocol, ClientState
from lanestream_client.frames import SourceFrame, StreamResult, StreamSummary

SUMMARY = SummaryMessage(frames=3, answered=3, failed=0, dropped=0, duration_s=1.0).model_dump_json()


def ready(*, last_seq: int | None = None, resumed: bool = False, token: str = "secret", **limits: Any) -> str:  # noqa: S107
    defaults = {"max_bytes": 10, "credits": 8}
    message = fakes.ready(
        resumed=resumed, last_seq=last_seq, resume_token=token, limits=fakes.limits(**{**defaults, **limits})
    )
    return message.model_dump_json()


def open_protocol(mode: Mode = "all", in_flight: int = 2, **limits: Any) -> ClientProtocol:
    clock = iter((5.0, 7.25))
    protocol = ClientProtocol(StartMessage(mode=mode), in_flight=in_flight, clock=lambda: next(clock))
    assert protocol.receive_ready(ready(**limits)) == []
    assert protocol.state is ClientState.OPEN
    return protocol


def lanes(seq: int) -> str:
    return fakes.lanes(seq).model_dump_json()


def error(code: str, seq: int | None = None, *, fatal: bool = False) -> str:
    return ErrorMessage(code=code, message="m", hint="h", seq=seq, fatal=fatal).model_dump_json()


def draining(token: str | None = "secret") -> str:  # noqa: S107
    return DrainingMessage(resume_token=token, deadline_s=5.0).model_dump_json()


def add(protocol: ClientProtocol, seq: int, data: bytes = b"x") -> None:
    protocol.add_frame(SourceFrame(seq, 0.5 * seq, data=data), data)


def sent(protocol: ClientProtocol) -> list[int | str]:
    """Takes all messages to send now, and returns the numbers of frames and the types of other messages."""
    taken: list[int | str] = []
    while messages := protocol.messages_to_send():
        message = json.loads(messages[0])
        taken.append(message.get("seq", message["type"]))
    return taken


def send(protocol: ClientProtocol, *numbers: int) -> None:
    for seq in numbers:
        add(protocol, seq)
        assert sent(protocol) == [seq]


def outcomes(results: list[StreamResult]) -> list[tuple[int, str]]:
    """Returns each result as its frame's number and its error's code, or `lanes`."""
    return [(result.frame.seq, result.error.code if result.error else "lanes") for result in results]


def counts(protocol: ClientProtocol) -> tuple[int, int, int, int, int]:
    total = protocol.summary
    assert total is not None
    assert protocol.state is ClientState.FINISHED
    assert total.frames == total.answered + total.failed + total.dropped + total.lost
    return total.frames, total.answered, total.failed, total.dropped, total.lost


def test_a_frame_is_sent_as_a_header_and_its_bytes() -> None:
    protocol = open_protocol()
    add(protocol, 3)
    text, data = protocol.messages_to_send()
    assert json.loads(text) == {"type": "frame", "seq": 3, "timestamp": 1.5}
    assert data == b"x"
    protocol.add_frame(SourceFrame(4, None, data=b"x"), b"x")
    text, _ = protocol.messages_to_send()
    assert json.loads(text) == {"type": "frame", "seq": 4}


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_two_frames_are_in_flight_until_one_is_answered(mode: Mode) -> None:
    protocol = open_protocol(mode)
    send(protocol, 0, 1)
    assert protocol.wants_frame
    add(protocol, 2)
    assert not protocol.wants_frame
    assert sent(protocol) == []
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]
    assert sent(protocol) == [2]
    assert protocol.wants_frame


def test_the_motion_of_the_vehicle_is_sent_with_its_frame() -> None:
    protocol = open_protocol()
    protocol.add_frame(SourceFrame(0, 0.0, speed=24.5, indicator="left"), b"x")
    header, _ = protocol.messages_to_send()
    assert json.loads(header) == {"type": "frame", "seq": 0, "timestamp": 0.0, "speed": 24.5, "indicator": "left"}


def test_warnings_are_kept_and_settle_no_frame() -> None:
    protocol = open_protocol()
    send(protocol, 0)
    warning = warning_message("timestamps_in_milliseconds", 0)
    assert protocol.receive(warning.model_dump_json()) == []
    assert protocol.warnings == (warning,)
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]


def test_the_service_can_grant_fewer_frames_in_flight() -> None:
    protocol = open_protocol(credits=1)
    send(protocol, 0)
    add(protocol, 1)
    assert sent(protocol) == []


def test_frame_numbers_must_rise() -> None:
    protocol = open_protocol()
    send(protocol, 1)
    with pytest.raises(ProtocolError, match="frame 1 came after frame 1"):
        add(protocol, 1)


def test_end_is_sent_once_after_the_last_frame() -> None:
    protocol = open_protocol(in_flight=1)
    send(protocol, 0)
    add(protocol, 1)
    protocol.end_source()
    assert protocol.messages_to_send() == []
    protocol.receive(lanes(0))
    assert sent(protocol) == [1, "end"]
    assert protocol.state is ClientState.ENDING
    protocol.receive(lanes(1))
    assert protocol.receive(SUMMARY) == []
    assert protocol.summary == StreamSummary(frames=2, answered=2, failed=0, dropped=0, lost=0, duration_s=2.25), (
        "counted by the client, over all connections"
    )


def test_unanswered_frames_before_an_answered_one_were_dropped_in_mode_latest() -> None:
    protocol = open_protocol("latest", in_flight=3)
    send(protocol, 0, 1, 2)
    assert outcomes(protocol.receive(lanes(1))) == [(1, "lanes")]
    protocol.end_source()
    assert sent(protocol) == ["end"]
    assert protocol.receive(SUMMARY) == []
    assert counts(protocol) == (3, 1, 0, 2, 0)


def test_unanswered_frames_before_an_answered_one_are_lost_in_mode_all() -> None:
    protocol = open_protocol("all", in_flight=3)
    send(protocol, 0, 1, 2)
    assert outcomes(protocol.receive(lanes(1))) == [(0, "lost"), (1, "lanes")]
    protocol.end_source()
    protocol.messages_to_send()
    assert outcomes(protocol.receive(SUMMARY)) == [(2, "lost")]


def test_a_frame_with_too_many_bytes_is_rejected_without_sending_it_and_reported_in_order() -> None:
    protocol = open_protocol()
    send(protocol, 0)
    add(protocol, 1, bytes(11))
    assert protocol.wants_frame
    assert sent(protocol) == []
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]
    send(protocol, 2)
    assert outcomes(protocol.receive(lanes(2))) == [(1, "image_too_large"), (2, "lanes")]
    add(protocol, 3, bytes(11))
    protocol.end_source()
    assert sent(protocol) == ["end"]
    assert outcomes(protocol.receive(SUMMARY)) == [(3, "image_too_large")]
    assert counts(protocol) == (4, 2, 2, 0, 0)


@pytest.mark.parametrize("code", ["bad_image", "too_fast", "expired", "image_too_large", "internal"])
def test_the_error_of_a_frame_is_its_result(code: str) -> None:
    protocol = open_protocol()
    send(protocol, 0)
    assert outcomes(protocol.receive(error(code, 0))) == [(0, code)]


def test_other_errors_are_raised_as_their_class() -> None:
    protocol = ClientProtocol(StartMessage())
    with pytest.raises(BusyError, match=r"m \(h\)"):
        protocol.receive_ready(error("busy", fatal=True))
    with pytest.raises(DrainingError):
        protocol.receive_ready(draining())
    with pytest.raises(OverrunError):
        open_protocol().receive(error("overrun", fatal=True))
    with pytest.raises(LanestreamError) as caught:
        open_protocol().receive(error("a_future_code", fatal=True))
    assert type(caught.value) is LanestreamError


INVALID = [b"bytes", "no json", "{}", '{"type": "lanes"}', ready(), lanes(7), error("draining", 7), SUMMARY]


@pytest.mark.parametrize("text", INVALID)
def test_an_invalid_message_is_a_protocol_error(text: str | bytes) -> None:
    with pytest.raises(ProtocolError):
        open_protocol().receive(text)


@pytest.mark.parametrize("text", [b"bytes", "no json", lanes(7), SUMMARY])
def test_an_invalid_answer_to_start_is_a_protocol_error(text: str | bytes) -> None:
    with pytest.raises(ProtocolError):
        ClientProtocol(StartMessage()).receive_ready(text)


def test_each_start_message_has_the_latest_token() -> None:
    protocol = ClientProtocol(StartMessage(mode="all", session="cam-7"))
    first = {"type": "start", "mode": "all", "session": "cam-7"}
    assert json.loads(protocol.start_message()) == first
    protocol.receive_ready(ready(token="one"))  # noqa: S106
    assert json.loads(protocol.start_message()) == {**first, "resume_token": "one"}
    protocol.receive(draining("two"))
    assert json.loads(protocol.start_message()) == {**first, "resume_token": "two"}
    protocol.connection_lost()
    protocol.receive_ready(ready(token="three"))  # noqa: S106
    assert protocol.reconnects == 1
    protocol.receive(draining(None))
    assert json.loads(protocol.start_message()) == {**first, "resume_token": "three"}


def test_in_mode_latest_sent_frames_are_lost_with_the_connection_and_waiting_ones_are_not() -> None:
    protocol = open_protocol("latest")
    send(protocol, 0, 1)
    add(protocol, 2)
    assert outcomes(protocol.connection_lost()) == [(0, "lost"), (1, "lost")]
    assert not protocol.wants_frame
    assert protocol.messages_to_send() == [], "there is no connection"
    assert protocol.receive_ready(ready(resumed=True, last_seq=0)) == []
    assert sent(protocol) == [2]
    assert outcomes(protocol.receive(lanes(2))) == [(2, "lanes")]


def test_in_mode_all_a_resumed_session_gets_the_frames_again_that_it_has_not_processed() -> None:
    protocol = open_protocol(in_flight=4)
    send(protocol, 0, 1, 2, 3)
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]
    assert protocol.connection_lost() == []
    assert outcomes(protocol.receive_ready(ready(resumed=True, last_seq=1))) == [(1, "lost")]
    assert sent(protocol) == [2, 3]
    assert outcomes(protocol.receive(lanes(2))) == [(2, "lanes")]


@pytest.mark.parametrize("answer", [{}, {"last_seq": 9}, {"resumed": True}])
def test_in_mode_all_a_session_that_has_processed_nothing_gets_all_frames_again(answer: dict[str, Any]) -> None:
    protocol = open_protocol(in_flight=3)
    send(protocol, 4, 5, 6)
    assert protocol.connection_lost() == []
    assert protocol.receive_ready(ready(**answer)) == []
    assert sent(protocol) == [4, 5, 6]


def test_resent_frames_must_fit_the_new_limits() -> None:
    protocol = open_protocol(in_flight=3)
    for seq, size in ((0, 1), (1, 9), (2, 1)):
        add(protocol, seq, bytes(size))
        assert sent(protocol) == [seq]
    protocol.connection_lost()
    protocol.receive_ready(ready(credits=1, max_bytes=5))
    assert sent(protocol) == [0]
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]
    assert sent(protocol) == [2]
    assert outcomes(protocol.receive(lanes(2))) == [(1, "image_too_large"), (2, "lanes")]


def test_losing_the_connection_twice_loses_and_repeats_nothing_more() -> None:
    protocol = open_protocol(in_flight=3)
    send(protocol, 0, 1, 2)
    protocol.connection_lost()
    assert protocol.connection_lost() == [], "no replica could be reached"
    assert outcomes(protocol.receive_ready(ready(resumed=True, last_seq=0))) == [(0, "lost")]
    assert protocol.connection_lost() == []
    assert protocol.receive_ready(ready(resumed=True, last_seq=0)) == []
    assert sent(protocol) == [1, 2]


def test_end_is_sent_again_over_the_next_connection() -> None:
    protocol = open_protocol()
    send(protocol, 0)
    protocol.end_source()
    assert sent(protocol) == ["end"]
    assert protocol.connection_lost() == []
    assert protocol.state is ClientState.DISCONNECTED
    assert protocol.summary is None
    protocol.receive_ready(ready())
    assert sent(protocol) == [0, "end"]
    protocol.receive(lanes(0))
    protocol.receive(SUMMARY)
    assert counts(protocol) == (1, 1, 0, 0, 0)


@pytest.mark.parametrize(("mode", "answered"), [("latest", False), ("latest", True), ("all", True)])
def test_a_stream_does_not_reconnect_for_the_summary_alone(mode: Mode, answered: bool) -> None:
    protocol = open_protocol(mode)
    send(protocol, 0)
    protocol.end_source()
    if answered:
        protocol.receive(lanes(0))
    assert outcomes(protocol.connection_lost()) == ([] if answered else [(0, "lost")])
    assert counts(protocol) == (1, int(answered), 0, 0, int(not answered))


@pytest.mark.parametrize(("mode", "lost"), [("latest", [(0, "lost"), (1, "image_too_large")]), ("all", [])])
def test_a_frame_rejected_by_the_client_is_reported_after_a_lost_connection(
    mode: Mode, lost: list[tuple[int, str]]
) -> None:
    protocol = open_protocol(mode)
    send(protocol, 0)
    add(protocol, 1, bytes(11))
    add(protocol, 2)
    assert outcomes(protocol.connection_lost()) == lost
    protocol.receive_ready(ready())
    assert sent(protocol) == ([2] if lost else [0, 2])
    results = [result for seq in ([2] if lost else [0, 2]) for result in protocol.receive(lanes(seq))]
    assert outcomes(results) == ([(2, "lanes")] if lost else [(0, "lanes"), (1, "image_too_large"), (2, "lanes")])


@pytest.mark.parametrize("mode", ["all", "latest"])
def test_a_draining_service_gets_no_more_frames_and_its_answers_count(mode: Mode) -> None:
    protocol = open_protocol(mode)
    send(protocol, 0)
    assert protocol.receive(draining()) == []
    assert protocol.is_draining
    add(protocol, 1)
    assert protocol.messages_to_send() == []
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]
    assert protocol.connection_lost() == []
    assert protocol.receive_ready(ready(resumed=True, last_seq=0)) == []
    assert not protocol.is_draining
    assert sent(protocol) == [1]


def test_in_mode_all_frames_refused_by_a_draining_service_are_sent_to_the_next() -> None:
    protocol = open_protocol(in_flight=4)
    send(protocol, 0, 1, 2, 3)
    protocol.receive(draining())
    assert outcomes(protocol.receive(lanes(0))) == [(0, "lanes")]
    assert protocol.receive(error("draining", 1)) == []
    assert protocol.receive(error("draining", 2)) == []
    assert protocol.connection_lost() == []
    assert protocol.receive_ready(ready(resumed=True, last_seq=0)) == []
    assert sent(protocol) == [1, 2, 3]


def test_in_mode_latest_frames_refused_by_a_draining_service_are_lost() -> None:
    protocol = open_protocol("latest", in_flight=3)
    send(protocol, 0, 1, 2)
    protocol.receive(draining())
    assert outcomes(protocol.receive(error("draining", 1))) == [(1, "lost")]
    assert outcomes(protocol.connection_lost()) == [(2, "lost")]
    protocol.end_source()
    assert outcomes(protocol.give_up()) == []
    assert counts(protocol) == (3, 0, 0, 1, 2)


def test_a_frame_that_was_requested_before_the_connection_was_lost_waits_behind_resent_ones() -> None:
    protocol = open_protocol(in_flight=2)
    send(protocol, 0)
    protocol.connection_lost()
    protocol.receive_ready(ready())
    add(protocol, 1)
    assert sent(protocol) == [0, 1]


def test_an_answer_before_a_frame_that_must_be_sent_again_is_out_of_order() -> None:
    protocol = open_protocol()
    send(protocol, 0, 1)
    protocol.receive(error("draining", 0))
    with pytest.raises(ProtocolError, match="answered frame 1 before"):
        protocol.receive(lanes(1))


def test_a_source_that_ends_without_a_connection_ends_the_stream_over_the_next() -> None:
    protocol = open_protocol()
    send(protocol, 0)
    protocol.receive(lanes(0))
    assert protocol.connection_lost() == []
    assert protocol.summary is None, "more frames may come"
    protocol.end_source()
    protocol.receive_ready(ready(resumed=True, last_seq=0))
    assert sent(protocol) == ["end"]


def test_giving_up_reports_every_frame() -> None:
    protocol = open_protocol(in_flight=1)
    send(protocol, 0)
    add(protocol, 1)
    protocol.connection_lost()
    assert outcomes(protocol.give_up()) == [(0, "lost"), (1, "lost")]
    assert counts(protocol) == (2, 0, 0, 0, 2)
    never_opened = ClientProtocol(StartMessage())
    assert never_opened.give_up() == []
    assert counts(never_opened) == (0, 0, 0, 0, 0)
