"""Throws mutated images at the decoder, or mutated texts at the parser of messages, with atheris.

    python tests/fuzz.py decoder -max_total_time=600
    python tests/fuzz.py messages -max_total_time=60

The seeds are made anew under out/fuzz/, where what is found is written as well; other arguments are libFuzzer's. What
breaks a promise ends the run with a traceback and a file `crash-...`, which is run again by naming it.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")

import atheris

with atheris.instrument_imports(
    include=["lanestream.images.header", "lanestream.images.decoding", "lanestream.protocol"]
):
    import bombs

    from lanestream.errors import ImageError, ProtocolError
    from lanestream.images.decoding import ImageLimits, decode
    from lanestream.protocol import parse_client_message

import cv2
import numpy as np

OUT: Final = Path("out/fuzz")
# Small, so that a run decodes thousands a second.
LIMITS: Final = ImageLimits(max_bytes=1 << 16, max_pixels=1 << 18)
# The decoder is not instrumented, so that seeds which only it tells apart would be given up.
ALWAYS: Final = ("-keep_seed=1", "-max_len=4096", "-timeout=5", "-rss_limit_mb=1024")
STARTS: Final = {"type": "start", "mode": "all", "horizon": 0.4, "camera": {"height": 1.4, "field_of_view": 60.0}}
MESSAGES: Final = (STARTS, {"type": "frame", "seq": 7, "timestamp": 0.28}, {"type": "end"})


def check_decoder(data: bytes) -> None:
    """Whatever comes in is an image within the limits, or an error in one line."""
    try:
        image = decode(data, LIMITS)
    except ImageError as error:
        if not error.message or "\n" in str(error):
            raise AssertionError(f"not one line: {error}") from error
        return
    height, width, channels = image.shape
    sides = sorted((height, width))
    if channels != 3 or image.dtype != np.uint8 or height * width > LIMITS.max_pixels or sides[0] < LIMITS.min_side:
        raise AssertionError(f"an image outside the limits: {image.shape} {image.dtype}")


def check_messages(data: bytes) -> None:
    """Whatever comes in is a message that is written as it is read, or an error in one line."""
    try:
        message = parse_client_message(data.decode(errors="surrogateescape"))
    except ProtocolError as error:
        if not error.message or "\n" in str(error):
            raise AssertionError(f"not one line: {error}") from error
        return
    if parse_client_message(message.model_dump_json()) != message:
        raise AssertionError(f"not read as it is written: {message!r}")


def mutated(data: bytes, most: int, seed: int) -> bytes:
    """Mutated data, three times of four mended so that they still look like a file and get past the first checks."""
    if seed % 4 == 0:
        return bytes(atheris.Mutate(data, most))
    if data.startswith(bombs.PNG_MAGIC):
        return mutated_png(data, seed)[:most]
    new = bytearray(atheris.Mutate(data, most))
    if data.startswith(b"\xff\xd8\xff"):
        new[:3], new[-2:] = b"\xff\xd8\xff", b"\xff\xd9"
    elif data.startswith(b"RIFF"):
        new[:12] = b"RIFF" + (max(len(new), 12) - 8).to_bytes(4, "little") + b"WEBP"
    return bytes(new[:most])


def mutated_png(data: bytes, seed: int) -> bytes:
    """A PNG with one of its chunks mutated, the others as they were, and all lengths and checksums right."""
    chunks, at = [], len(bombs.PNG_MAGIC)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : end]))
        at = end + 4
    if chunks:
        index = seed // 4 % len(chunks)
        kind, inside = chunks[index]
        chunks[index] = kind, bytes(atheris.Mutate(inside, len(inside) + 64))
    return bombs.PNG_MAGIC + b"".join(bombs.png_chunk(*chunk) for chunk in chunks)


def images() -> list[bytes]:
    """Small image files of every kind and of several ways to write each."""
    ramp = np.tile(np.linspace(0, 255, 72).astype(np.uint8)[None, :, None], (64, 1, 3))
    with_alpha = np.dstack([ramp, ramp[..., :1]])
    ways = (
        (".jpg", ramp, []),
        (".jpg", ramp, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".jpg", ramp, [cv2.IMWRITE_JPEG_RST_INTERVAL, 2]),
        (".jpg", ramp[..., 0], []),
        (".png", ramp, []),
        (".png", ramp.astype(np.uint16) * 257, []),
        (".png", with_alpha, []),
        (".png", ramp[..., 0], [cv2.IMWRITE_PNG_BILEVEL, 1]),
        (".webp", ramp, []),
        (".webp", ramp, [cv2.IMWRITE_WEBP_QUALITY, 20]),
        (".webp", with_alpha, [cv2.IMWRITE_WEBP_QUALITY, 20]),
    )
    return [cv2.imencode(kind, image, flags)[1].tobytes() for kind, image, flags in ways]


def texts() -> list[bytes]:
    """A message of every type."""
    return [json.dumps(message).encode() for message in MESSAGES]


TARGETS: Final[dict[str, tuple[Callable[[bytes], None], Callable[[], list[bytes]]]]] = {
    "decoder": (check_decoder, images),
    "messages": (check_messages, texts),
}


def main(name: str, *options: str) -> None:
    """Fuzzes the target `name`, with `options` for libFuzzer; a file among them is run alone."""
    check, seeds = TARGETS[name]
    folder = OUT / name
    folder.mkdir(parents=True, exist_ok=True)
    for index, seed in enumerate(seeds()):
        (folder / f"seed-{index}").write_bytes(seed)
    alone = [option for option in options if not option.startswith("-")]
    arguments = [sys.argv[0], f"-artifact_prefix={OUT}/{name}-", *ALWAYS]
    atheris.Setup([*arguments, *options, *([] if alone else [str(folder)])], check, custom_mutator=mutated)
    atheris.Fuzz()


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        sys.exit(f"usage: {sys.argv[0]} {{{'|'.join(TARGETS)}}} [-max_total_time=SECONDS | FILE] ...")
    main(*sys.argv[1:])
