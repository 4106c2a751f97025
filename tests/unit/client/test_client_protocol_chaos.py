"""Whatever happens to its sockets, each frame of a stream comes to one result, or is counted as dropped."""

from __future__ import annotations

import json

import fakes
from hypothesis import given, settings
from hypothesis import strategies as st

from lanestream.errors import DrainingError
from lanestream.protocol import DrainingMessage, Mode, StartMessage, SummaryMessage, error_message
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.frames import SourceFrame, StreamResult

TOO_BIG = 7  # every seventh frame has more bytes than the service accepts


class World:
    """A source, a conversation and a service that keeps to the protocol, each of which moves when it is told to."""

    def __init__(self, mode: Mode, in_flight: int) -> None:
        self.mode: Mode = mode
        self.conversation = ClientProtocol(StartMessage(mode=mode), in_flight=in_flight, clock=lambda: 0.0)
        self.results: list[StreamResult] = []
        self.frames = 0
        self.worked_on: int | None = None
        self._open(resumed=False)

    def _open(self, *, resumed: bool) -> None:
        self.queue: list[tuple[int, bool]] = []  # frames that came, and whether they were refused
        self.replies: list[str] = []
        self.draining = self.ended = False
        ready = fakes.ready(resumed=resumed, last_seq=self.worked_on if resumed else None)
        limits = ready.limits.model_copy(update={"max_bytes": 10})
        self.results += self.conversation.opened(ready.model_copy(update={"limits": limits}).model_dump_json())

    def source(self) -> None:
        if self.conversation.wants_frame:
            data = bytes(11 if self.frames % TOO_BIG == TOO_BIG - 1 else 1)
            self.conversation.offer(SourceFrame(self.frames, None, data=data), data)
            self.frames += 1

    def send(self) -> None:
        for message in self.conversation.outgoing()[:1]:
            told = json.loads(message)
            if told["type"] == "end":
                self.ended = True
            else:
                self.queue.append((told["seq"], self.draining))

    def drop(self) -> None:
        if self.mode == "latest" and len(self.queue) > 1:
            del self.queue[0]

    def work(self) -> None:
        if self.queue:
            seq, refused = self.queue.pop(0)
            if refused:
                self.replies.append(error_message(DrainingError("too late"), seq=seq).model_dump_json())
            else:
                self.worked_on = seq
                self.replies.append(fakes.lanes(seq).model_dump_json())

    def hear(self) -> None:
        if self.replies:
            self.results += self.conversation.incoming(self.replies.pop(0))

    def drain(self) -> None:
        if not self.draining:
            self.draining = True
            self.replies.append(DrainingMessage(resume_token=None, deadline_s=1.0).model_dump_json())

    def lose(self) -> None:
        """The socket breaks, and the session goes on over another."""
        self.results += self.conversation.lost_connection()
        self._open(resumed=True)

    def forget(self) -> None:
        """The socket breaks, and nobody knows the session any more."""
        self.results += self.conversation.lost_connection()
        self._open(resumed=False)

    def end(self) -> None:
        """The source is over, and the service goes on in peace."""
        self.conversation.no_more()
        self.lose()
        while self.conversation.summary is None and not self.ended:
            for move in (self.send, self.work, self.hear):
                move()
        while self.queue or self.replies:
            self.work()
            self.hear()
        if self.conversation.summary is None:
            total = SummaryMessage(frames=0, answered=0, failed=0, dropped=0, duration_s=0.0)
            self.results += self.conversation.incoming(total.model_dump_json())


# What breaks is rare beside what goes on.
MOVES = ["source", "send", "work", "hear"] * 4 + ["drop", "drain", "lose", "forget"]


@settings(deadline=None)
@given(st.sampled_from(["all", "latest"]), st.integers(1, 4), st.lists(st.sampled_from(MOVES), max_size=120))
def test_each_frame_comes_to_one_result(mode: Mode, in_flight: int, moves: list[str]) -> None:
    world = World(mode, in_flight)
    for move in moves:
        getattr(world, move)()
    world.end()
    numbers = [result.frame.seq for result in world.results]
    total = world.conversation.summary
    assert total is not None
    assert numbers == sorted(set(numbers)), "in order, none twice"
    assert total.frames == world.frames == len(numbers) + total.dropped
    assert (total.dropped == 0) or mode == "latest"
    codes = [result.error.code if result.error else "lanes" for result in world.results]
    assert set(codes) <= {"lanes", "lost", "image_too_large"}
    assert (codes.count("lanes"), codes.count("lost")) == (total.answered, total.lost)
    refused = [number for number in range(world.frames) if number % TOO_BIG == TOO_BIG - 1]
    assert [seq for seq, code in zip(numbers, codes, strict=True) if code == "image_too_large"] == refused
