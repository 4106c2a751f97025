"""The image in the body of a single request: limits its size, its duration and how many bodies are read at a time."""

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

# What boundaries and part headers may add to the file of a multipart body.
_MULTIPART_OVERHEAD: Final = 1 << 16


class BodyReader:
    """Reads images of at most `max_bytes`, up to `concurrency` at a time, each within `body_s` seconds.

    A body that arrives slowly or never ends occupies one of these reads, but no session.
    """

    def __init__(self, max_bytes: int, concurrency: int, body_s: float) -> None:
        self._max_bytes = max_bytes
        self._concurrency = concurrency
        self._body_s = body_s
        self._reading = 0

    async def read_image(self, request: Request) -> bytes:
        """Returns the image file in the body, or in the field `file` of a form.

        Raises BusyError if too many bodies are being read, IdleError if the body takes too long, ImageTooLargeError
        if it is too large, and ProtocolError if it is malformed.
        """
        if self._reading >= self._concurrency:
            raise BusyError(f"{self._concurrency} images are being received, which is the limit", "try again later")
        self._reading += 1
        try:
            async with asyncio.timeout(self._body_s):
                return await self._read(request)
        except TimeoutError:
            raise IdleError(
                f"the request was not complete after {self._body_s:g} seconds", "send a smaller JPEG, or use a stream"
            ) from None
        finally:
            self._reading -= 1

    async def _read(self, request: Request) -> bytes:
        if request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return await self._read_form(request)
        return b"".join([chunk async for chunk in _chunks(request, self._max_bytes)])

    async def _read_form(self, request: Request) -> bytes:
        body = _chunks(request, self._max_bytes + _MULTIPART_OVERHEAD)
        parser = MultiPartParser(request.headers, body, max_files=1, max_fields=8)
        parser.spool_max_size = self._max_bytes + 1
        try:
            form = await parser.parse()
        except (MultiPartException, UnicodeError) as error:
            reason = error.message if isinstance(error, MultiPartException) else "the encoding of a name is not valid"
            raise ProtocolError(f"the form can't be read: {reason}", "send the image as the field `file`") from None
        try:
            file = form.get("file")
            if not isinstance(file, UploadFile):
                raise ProtocolError("the form has no file in the field `file`", "use curl -F file=@road.jpg")
            return await file.read()
        finally:
            await form.close()


async def _chunks(request: Request, max_bytes: int) -> AsyncGenerator[bytes]:
    """Yields the body in chunks. Reads at most `max_bytes` and one chunk; raises ImageTooLargeError beyond that."""
    declared = request.headers.get("content-length", "")
    size = int(declared) if declared.isdecimal() else 0
    if size <= max_bytes:
        size = 0
        try:
            async for chunk in request.stream():
                size += len(chunk)
                if size > max_bytes:
                    break
                yield chunk
        except ClientDisconnect:
            raise ProtocolError("the client disconnected before the end of its request") from None
    if size > max_bytes:
        raise ImageTooLargeError(f"the request exceeds the limit of {max_bytes:,} bytes", "send a smaller JPEG")
