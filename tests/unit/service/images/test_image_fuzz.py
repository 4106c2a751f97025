"""Randomly damaged image files: each is an image within the limits, or an error in one line."""

from __future__ import annotations

import bombs
import fakes
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lanestream.errors import ImageError
from lanestream.images.decoding import ImageLimits, decode

LIMITS = ImageLimits(max_bytes=100_000, max_pixels=1 << 18)
FILES = {
    "jpeg": fakes.image_file(".jpg", 72, 64),
    "png": fakes.image_file(".png", 72, 64),
    "webp": fakes.image_file(".webp", 72, 64),
    "animated webp": bombs.webp((72, 64), fakes.image_file(".webp", 72, 64), animated=True),
    "animated png": bombs.apng((320, 180), 3),
    "progressive jpeg": bombs.jpeg_of_scans(3),
}


@st.composite
def damage(draw: st.DrawFn, data: bytes) -> bytes:
    """Draws `data` with bytes replaced, removed, duplicated or taken from other files, mostly in the header."""
    for _ in range(draw(st.integers(1, 4))):
        reach = min(len(data), draw(st.sampled_from([40, 200, 100_000])))
        start = draw(st.integers(0, reach))
        end = start + draw(st.integers(0, 30))
        other = FILES[draw(st.sampled_from(sorted(FILES)))]
        inserted = draw(
            st.one_of(
                st.binary(max_size=8),
                st.just(data[start:end] * 2),
                st.sampled_from([b"\xff\x01", b"\xff\xd8", b"\xff\xff\xff\xff", bytes(4), b"\x00\x00\xff\xff"]),
                st.integers(0, len(other)).map(lambda at, other=other: other[at : at + 60]),  # type: ignore[misc]
            )
        )
        data = data[:start] + inserted + data[end:]
    return bombs.with_checksums(data) if draw(st.booleans()) else data


@pytest.mark.parametrize("kind", FILES)
@given(data=st.data())
@settings(max_examples=150, derandomize=True, deadline=None)
def test_a_damaged_file_is_an_image_or_an_error_in_one_line(kind: str, data: st.DataObject) -> None:
    damaged = data.draw(damage(FILES[kind]))
    try:
        image = decode(damaged, LIMITS)
    except ImageError as caught:
        error = caught
    else:
        assert image.dtype == np.uint8
        assert image.ndim == 3
        assert image.shape[0] * image.shape[1] <= LIMITS.max_pixels
        assert min(image.shape[:2]) >= LIMITS.min_side
        return
    assert error.message
    assert "\n" not in str(error)
