"""Fuzzes the image decoder or the message parser with atheris.

    python tests/fuzz.py decoder -max_total_time=600
    python tests/fuzz.py messages -max_total_time=60

Seeds and findings are in out/fuzz/; the seeds are rewritten at each start. Other arguments are libFuzzer's. A failure
ends the run with a traceback and a file `crash-...`; name that file as an argument to reproduce it.
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
# Small, so that a run decodes thousands of images per second.
LIMITS: Final = ImageLimits(max_bytes=1 << 16, max_pixels=1 << 18)
# Without keep_seed, libFuzzer drops seeds that differ only in OpenCV, because OpenCV is not instrumented.
OPTIONS: Final = ("-keep_seed=1", "-max_len=4096", "-timeout=5", "-rss_limit_mb=1024")
START: Final = {"type": "start", "mode": "all", "horizon": 0.4, "camera": {"height": 1.4, "field_of_view": 60.0}}
MESSAGES: Final = (START, {"type": "frame", "seq": 7, "timestamp": 0.28}, {"type": "end"})


def check_decoder(data: bytes) -> None:
    """Checks that `data` is decoded to an image within the limits, or refused with an error in one line."""
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
    """Checks that `data` is a message that survives a round trip, or refused with an error in one line."""
    try:
        message = parse_client_message(data.decode(errors="surrogateescape"))
    except ProtocolError as error:
        if not error.message or "\n" in str(error):
            raise AssertionError(f"not one line: {error}") from error
        return
    if parse_client_message(message.model_dump_json()) != message:
        raise AssertionError(f"changed by a round trip: {message!r}")


def mutate(data: bytes, max_size: int, seed: int) -> bytes:
    """Returns mutated data, in three of four cases with a valid file header, so that they pass the first checks."""
    if seed % 4 == 0:
        return bytes(atheris.Mutate(data, max_size))
    if data.startswith(bombs.PNG_MAGIC):
        return mutate_png(data, seed)[:max_size]
    new = bytearray(atheris.Mutate(data, max_size))
    if data.startswith(b"\xff\xd8\xff"):
        new[:3], new[-2:] = b"\xff\xd8\xff", b"\xff\xd9"
    elif data.startswith(b"RIFF"):
        new[:12] = b"RIFF" + (max(len(new), 12) - 8).to_bytes(4, "little") + b"WEBP"
    return bytes(new[:max_size])


def mutate_png(data: bytes, seed: int) -> bytes:
    """Returns a PNG with one mutated chunk and correct lengths and checksums."""
    chunks, at = [], len(bombs.PNG_MAGIC)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        chunks.append((data[at + 4 : at + 8], data[at + 8 : end]))
        at = end + 4
    if chunks:
        index = seed // 4 % len(chunks)
        kind, content = chunks[index]
        chunks[index] = kind, bytes(atheris.Mutate(content, len(content) + 64))
    return bombs.PNG_MAGIC + b"".join(bombs.png_chunk(*chunk) for chunk in chunks)


def image_seeds() -> list[bytes]:
    """Returns small image files of every format, in several variants."""
    ramp = np.tile(np.linspace(0, 255, 72).astype(np.uint8)[None, :, None], (64, 1, 3))
    with_alpha = np.dstack([ramp, ramp[..., :1]])
    variants = (
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
    return [cv2.imencode(kind, image, flags)[1].tobytes() for kind, image, flags in variants]


def message_seeds() -> list[bytes]:
    """Returns a message of every type."""
    return [json.dumps(message).encode() for message in MESSAGES]


TARGETS: Final[dict[str, tuple[Callable[[bytes], None], Callable[[], list[bytes]]]]] = {
    "decoder": (check_decoder, image_seeds),
    "messages": (check_messages, message_seeds),
}


def main(name: str, *options: str) -> None:
    """Fuzzes the target `name` with `options` for libFuzzer. If a file is among them, only that file is run."""
    check, seeds = TARGETS[name]
    folder = OUT / name
    folder.mkdir(parents=True, exist_ok=True)
    for index, seed in enumerate(seeds()):
        (folder / f"seed-{index}").write_bytes(seed)
    files = [option for option in options if not option.startswith("-")]
    arguments = [sys.argv[0], f"-artifact_prefix={OUT}/{name}-", *OPTIONS]
    atheris.Setup([*arguments, *options, *([] if files else [str(folder)])], check, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in TARGETS:
        sys.exit(f"usage: {sys.argv[0]} {{{'|'.join(TARGETS)}}} [-max_total_time=SECONDS | FILE] ...")
    main(*sys.argv[1:])
