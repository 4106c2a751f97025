"""Pixels of frames: which arrays are accepted, and how they become JPEG files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from lanestream.errors import ImageError, needs_extra, one_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    BgrImage = NDArray[np.uint8]  # (H, W, 3)

# The format has no room for more.
_MOST_JPEG_SIDE: Final = 65535
_HINT: Final = "give uint8 pixels of shape (H, W, 3) in the order blue, green, red; rgb[..., ::-1] converts RGB"


def check_pixels(pixels: object, size: tuple[int, int] | None = None) -> None:
    """Raises ImageError if `pixels` is not an array (H, W, 3) of uint8, of `size` (width, height) if given."""
    dtype, shape = getattr(pixels, "dtype", None), getattr(pixels, "shape", None)
    if dtype is None or not isinstance(shape, tuple):
        raise ImageError(f"the frame is of type {type(pixels).__name__}, not a NumPy array", _HINT)
    if str(dtype) != "uint8" or len(shape) != 3 or shape[2] != 3 or 0 in shape:
        raise ImageError(f"the frame has the type {one_line(dtype)} and the shape {shape}", _HINT)
    if size is not None and (shape[1], shape[0]) != size:
        raise ImageError(
            f"the frame is {shape[1]} x {shape[0]}, but its lanes are in pixels of {size[0]} x {size[1]}",
            "give the frame in the size in which it was sent",
        )


def encode_jpeg(pixels: BgrImage, quality: int) -> bytes:
    """Returns a JPEG of BGR pixels (H, W, 3) uint8; `quality` is from 0 to 100.

    Raises ImageError if the image is too large for a JPEG.
    """
    height, width = pixels.shape[:2]
    if max(height, width) > _MOST_JPEG_SIDE:
        raise ImageError(
            f"the frame is {width} x {height}, too large for a JPEG", f"at most {_MOST_JPEG_SIDE} pixels per side"
        )
    with needs_extra("video"):
        import cv2
        import numpy as np
    # OpenCV does not read arrays with negative strides, such as those of a mirrored image.
    return cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
