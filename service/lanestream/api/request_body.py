"""The image file in the body of a single request: how much is read of it, for how long, and of how many at a time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Final

from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect

from lanestream.errors import BusyError, IdleError, ImageTooLargeError, ProtocolError

if TYPE_CHECKING:
    from starlette.requests import Request

# What boundaries and part headers may add to the bytes of a multipart body's one file.
_MULTIPART_EXTRA: Final = 1 << 16


class BodyReader:
    """Reads bodies of at most `most` bytes of image, `places` of them at a time, each within `body_s` seconds.

    A body that trickles in, or that never ends, holds one of these places for a while, but no session's.
    """

    def __init__(self, most: int, places: int, body_s: float) -> None:
        self._most = most
        self._places = places
        self._body_s = body_s
        self._reading = 0

    async def image_file(self, request: Request) -> bytes:
        """The image file in the body, or in the field `file` of its form.

        Raises BusyError where no place is free, IdleError where the body takes too long, ImageTooLargeError where it
        is too large, ProtocolError where it can't be read.
        """
        if self._reading >= self._places:
            raise BusyError(f"{self._places} images are being received, which is the most", "try again later")
        self._reading += 1
        try:
            async with asyncio.timeout(self._body_s):
                return await self._read(request)
        except TimeoutError:
            raise IdleError(
                f"the request was not complete after {self._body_s:g} seconds", "send a smaller JPEG, or a stream"
            ) from None
        finally:
            self._reading -= 1

    async def _read(self, request: Request) -> bytes:
        if request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return await self._form_file(request)
        return b"".join([chunk async for chunk in _limited(request, self._most)])

    async def _form_file(self, request: Request) -> bytes:
        body = _limited(request, self._most + _MULTIPART_EXTRA)
        parser = MultiPartParser(request.headers, body, max_files=1, max_fields=8)
        parser.spool_max_size = self._most + 1
        try:
            form = await parser.parse()
        except (MultiPartException, UnicodeError) as error:
            why = error.message if isinstance(error, MultiPartException) else "its names are in no known encoding"
            raise ProtocolError(f"the form can't be read: {why}", "send the image as the field `file`") from None
        try:
            file = form.get("file")
            if not isinstance(file, UploadFile):
                raise ProtocolError("the form has no file named `file`", "curl -F file=@road.jpg")
            return await file.read()
        finally:
            await form.close()


async def _limited(request: Request, most: int) -> AsyncGenerator[bytes]:
    """The body, chunk by chunk; no more of it is ever read than `most` bytes and one chunk."""
    declared = request.headers.get("content-length", "")
    size = int(declared) if declared.isdecimal() else 0
    if size <= most:
        size = 0
        try:
            async for chunk in request.stream():
                size += len(chunk)
                if size > most:
                    break
                yield chunk
        except ClientDisconnect:
            raise ProtocolError("the client went away before the end of its request") from None
    if size > most:
        raise ImageTooLargeError(
            f"the request has more than the {most:,} bytes that are accepted", "send a smaller JPEG"
        )
