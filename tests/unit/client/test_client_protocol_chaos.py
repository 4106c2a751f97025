"""Each frame of a stream gets exactly one result or is counted as dropped, even if sockets break at random."""

from __future__ import annotations

import json

import fakes
from hypothesis import given, settings
from hypothesis import strategies as st

from lanestream.errors import DrainingError
from lanestream.protocol import DrainingMessage, Mode, StartMessage, SummaryMessage, error_message
from lanestream_client.client_protocol import ClientProtocol
from lanestream_client.frames import SourceFrame, StreamResult

MAX_BYTES = 10
TOO_LARGE_EVERY = 7  # every seventh frame has more bytes than the service accepts


def is_too_large(seq: int) -> bool:
    return seq % TOO_LARGE_EVERY == TOO_LARGE_EVERY - 1


class Simulation:
    """A source, a client protocol and a correct service. Each method is one step of one of them."""

    def __init__(self, mode: Mode, in_flight: int) -> None:
        self.mode: Mode = mode
        self.protocol = ClientProtocol(StartMessage(mode=mode), in_flight=in_flight, clock=lambda: 0.0)
        self.results: list[StreamResult] = []
        self.frames = 0
        self.last_processed: int | None = None
        self._connect(resumed=False)

    def _connect(self, *, resumed: bool) -> None:
        self.queue: list[tuple[int, bool]] = []  # received frames, and whether the service refuses them
        self.replies: list[str] = []
        self.draining = self.ended = False
        ready = fakes.ready(resumed=resumed, last_seq=self.last_processed if resumed else None)
        limits = ready.limits.model_copy(update={"max_bytes": MAX_BYTES})
        self.results += self.protocol.receive_ready(ready.model_copy(update={"limits": limits}).model_dump_json())

    def read_source(self) -> None:
        if self.protocol.wants_frame:
            data = bytes(MAX_BYTES + 1 if is_too_large(self.frames) else 1)
            self.protocol.add_frame(SourceFrame(self.frames, None, data=data), data)
            self.frames += 1

    def send(self) -> None:
        for text in self.protocol.messages_to_send()[:1]:
            message = json.loads(text)
            if message["type"] == "end":
                self.ended = True
            else:
                self.queue.append((message["seq"], self.draining))

    def drop(self) -> None:
        if self.mode == "latest" and len(self.queue) > 1:
            del self.queue[0]

    def process(self) -> None:
        if self.queue:
            seq, refused = self.queue.pop(0)
            if refused:
                self.replies.append(error_message(DrainingError("too late"), seq=seq).model_dump_json())
            else:
                self.last_processed = seq
                self.replies.append(fakes.lanes(seq).model_dump_json())

    def receive(self) -> None:
        if self.replies:
            self.results += self.protocol.receive(self.replies.pop(0))

    def drain(self) -> None:
        if not self.draining:
            self.draining = True
            self.replies.append(DrainingMessage(resume_token=None, deadline_s=1.0).model_dump_json())

    def reconnect(self) -> None:
        """Loses the socket and resumes the session over another."""
        self.results += self.protocol.connection_lost()
        self._connect(resumed=True)

    def lose_session(self) -> None:
        """Loses the socket and the session, and opens a new one."""
        self.results += self.protocol.connection_lost()
        self._connect(resumed=False)

    def finish(self) -> None:
        """Ends the source, and runs the service without further faults until the stream has finished."""
        self.protocol.end_source()
        self.reconnect()
        while self.protocol.summary is None and not self.ended:
            for step in (self.send, self.process, self.receive):
                step()
        while self.queue or self.replies:
            self.process()
            self.receive()
        if self.protocol.summary is None:
            total = SummaryMessage(frames=0, answered=0, failed=0, dropped=0, duration_s=0.0)
            self.results += self.protocol.receive(total.model_dump_json())


# Faults are rare compared with normal steps.
STEPS = ["read_source", "send", "process", "receive"] * 4 + ["drop", "drain", "reconnect", "lose_session"]


@settings(deadline=None)
@given(st.sampled_from(["all", "latest"]), st.integers(1, 4), st.lists(st.sampled_from(STEPS), max_size=120))
def test_each_frame_gets_one_result(mode: Mode, in_flight: int, steps: list[str]) -> None:
    simulation = Simulation(mode, in_flight)
    for step in steps:
        getattr(simulation, step)()
    simulation.finish()
    numbers = [result.frame.seq for result in simulation.results]
    total = simulation.protocol.summary
    assert total is not None
    assert numbers == sorted(set(numbers)), "in order, without duplicates"
    assert total.frames == simulation.frames == len(numbers) + total.dropped
    assert (total.dropped == 0) or mode == "latest"
    codes = [result.error.code if result.error else "lanes" for result in simulation.results]
    assert set(codes) <= {"lanes", "lost", "image_too_large"}
    assert (codes.count("lanes"), codes.count("lost")) == (total.answered, total.lost)
    too_large = [seq for seq in range(simulation.frames) if is_too_large(seq)]
    assert [seq for seq, code in zip(numbers, codes, strict=True) if code == "image_too_large"] == too_large
