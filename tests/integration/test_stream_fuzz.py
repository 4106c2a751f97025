"""Streams of clients that send anything: every reply is a valid message, and every frame is accounted for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field

import bombs
import fakes
from hypothesis import given, settings
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed
from wsclient import receive, stream

from lanestream.errors import ProtocolError
from lanestream.protocol import (
    EndMessage,
    ErrorMessage,
    LanesMessage,
    ServerMessage,
    SummaryMessage,
    parse_client_message,
    parse_server_message,
)

Sent = str | bytes

IMAGE = fakes.image_file()
POISONED = fakes.image_file(shade=255)  # the fake detector fails at it
TOO_LARGE = bytes(200_001)  # for the server of `url`
# The errors that a client can provoke in a working service; `internal` only with poisoned frames.
CODES = {"bad_message", "bad_image", "image_too_large", "no_detector", "overrun", "internal"}

numbers = st.one_of(
    st.integers(-5, 50),
    st.floats(),
    st.sampled_from([2**31, 2**53 - 1, 2**53, 2**63, 2**64, 10**30, 10**4000, 1e15, 5e-324, -0.0]),
)
junk = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
starts = st.fixed_dictionaries(
    {"type": st.just("start")},
    optional={
        "mode": st.sampled_from(["latest", "all"]),
        "session": st.sampled_from(["front", "a.b-c_1"]),
        "resume_token": st.text("abc-_", max_size=130),
        "detector": st.sampled_from(["candidates", "regression", None]),
        "horizon": st.floats(-0.6, 0.99),
        "camera": st.just({"height": 1.4, "field_of_view": 60}),
    },
)
frames = st.fixed_dictionaries(
    {"type": st.just("frame")},
    optional={"seq": st.integers(0, 2**53 - 1), "timestamp": st.floats(-1e15, 1e15) | st.floats(0.0, 9.0)},
)
messages = starts | frames
names = st.sampled_from(
    ["type", "mode", "seq", "timestamp", "horizon", "camera", "session", "resume_token", "detector", "else"]
)
corrupted = st.builds(
    lambda message, name, value: {**message, name: value}, messages, names | st.text(max_size=9), junk
)
texts = st.one_of(
    messages.map(json.dumps),
    corrupted.map(json.dumps),
    junk.map(json.dumps),
    st.text(max_size=20),
    st.sampled_from(["{" * 5000, '{"type": "frame", "seq": ' + "9" * 5000 + "}", '{"type": "end", "type": "start"}']),
)
images = st.one_of(
    st.sampled_from([IMAGE, fakes.image_file(".png"), fakes.image_file(".webp"), fakes.image_file(width=640)]),
    st.sampled_from([POISONED, b"", IMAGE[:900], fakes.image_file(".png", 1, 1), TOO_LARGE]),
    st.sampled_from([bombs.jpeg_behind_a_marker(), bombs.apng((320, 180), 3), bombs.jpeg_of_scans(101)]),
    st.binary(max_size=40),
    st.integers(20, len(IMAGE) - 9).map(lambda at: IMAGE[:at] + b"\xff\x07" + IMAGE[at + 2 :]),
)


@dataclass
class Received:
    """The messages received over a stream, and its close code; 0 without one."""

    messages: list[ServerMessage] = field(default_factory=list)
    code: int = 0

    @property
    def errors(self) -> list[ErrorMessage]:
        return [message for message in self.messages if isinstance(message, ErrorMessage)]


def exchange(url: str, sent: Sequence[Sent]) -> Received:
    """Sends all messages, as far as the service reads them, and receives until the stream is closed."""
    received = Received()
    with stream(url) as socket:
        try:
            for message in sent:
                socket.send(message)
        except ConnectionClosed:
            pass
        try:
            while True:
                text = socket.recv(fakes.WAIT_S)
                assert isinstance(text, str)
                received.messages.append(parse_server_message(text))
        except ConnectionClosed as closed:
            received.code = 0 if closed.rcvd is None else closed.rcvd.code
    return received


def is_end(message: Sent) -> bool:
    try:
        return isinstance(message, str) and isinstance(parse_client_message(message), EndMessage)
    except ProtocolError:
        return False


@given(before=st.lists(texts | images | images, max_size=14), after=st.lists(texts | images, max_size=2))
@settings(max_examples=120, derandomize=True, deadline=None, database=None)
def test_any_sequence_of_messages_is_answered_and_counted(url: str, before: list[Sent], after: list[Sent]) -> None:
    sent = [*before, '{"type": "end"}', *after]
    counted = sent[: next(at for at, message in enumerate(sent) if is_end(message))]
    frames = [message for message in counted if isinstance(message, bytes)]
    received = exchange(url, sent)
    errors = received.errors

    assert {error.code for error in errors} <= CODES
    assert sum(error.code == "internal" for error in errors) <= frames.count(POISONED)
    assert all(error.message and "\n" not in error.message + error.hint for error in errors)
    if received.code == 1000:
        check_count(received, frames)
    else:
        assert (received.code, errors[-1].code, errors[-1].fatal) == (1008, "overrun", True)
        assert len(frames) > 8
    with stream(url) as fresh:
        fresh.send(IMAGE)
        assert [lane["position"] for lane in receive(fresh)["lanes"]] == [-1, 1]


def check_count(received: Received, frames: Sequence[bytes]) -> None:
    """Checks that every frame before the end is answered, failed with its number, or dropped."""
    summary = received.messages[-1]
    assert isinstance(summary, SummaryMessage)
    answered = sum(isinstance(message, LanesMessage) for message in received.messages)
    failed = sum(error.seq is not None for error in received.errors)
    assert (summary.frames, summary.answered, summary.failed) == (len(frames), answered, failed)
    assert summary.frames == summary.answered + summary.failed + summary.dropped
    assert not [error for error in received.errors if error.fatal]
