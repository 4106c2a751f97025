"""Headers of WebSocket frames, against those that a library writes."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from websockets.frames import Frame, Opcode

from lanestream.api.websocket_connection import read_frame_header

frames = st.builds(
    Frame,
    st.sampled_from([Opcode.CONT, Opcode.TEXT, Opcode.BINARY]),
    st.one_of(st.binary(max_size=200), st.sampled_from([bytes(size) for size in (125, 126, 65_535, 65_536)])),
    st.booleans(),
)


@given(frames, st.booleans(), st.integers(0, 20))
def test_the_header_of_a_frame_is_read_from_any_part_of_it(frame: Frame, mask: bool, cut: int) -> None:
    data = frame.serialize(mask=mask)
    header = read_frame_header(data + b"next")
    assert header is not None
    assert (header.opcode, header.final) == (frame.opcode, frame.fin)
    assert (header.payload, header.size) == (len(frame.data), len(data))
    assert read_frame_header(data[:cut]) in (None, header)
    assert read_frame_header(b"") is None
