"""The image in the body of a single request: limits its size, its duration, and how much all bodies may take."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from starlette.datastructures import UploadFile
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import ClientDisconnect

from lanestream.errors import BusyError, IdleError, ImageTooLargeError, ProtocolError

if TYPE_CHECKING:
    from starlette.requests import Request

    from lanestream.api.byte_budget import ByteBudget, Charge

# What boundaries and part headers may add to the file of a multipart body.
_MULTIPART_OVERHEAD: Final = 1 << 16


@dataclass(frozen=True)
class BodyLimits:
    """Limits of bodies: bytes of an image, seconds until it has arrived, and bodies read at a time, in all and each."""

    max_bytes: int
    body_s: float
    bodies: int
    bodies_per_caller: int


class BodyReader:
    """Reads images within `limits`. What it keeps of them is charged to the caller's part of `budget`.

    A body that arrives slowly or never ends occupies one of these reads, but no session.
    """

    def __init__(self, limits: BodyLimits, budget: ByteBudget) -> None:
        self._limits = limits
        self._budget = budget
        self._reading: Counter[str] = Counter()

    @asynccontextmanager
    async def image(self, request: Request, caller: str) -> AsyncIterator[bytes]:
        """Yields the image file in the body, or in the field `file` of a form, which is charged for during the block.

        Raises BusyError if too many bodies are being read or too much is kept of them, IdleError if the body takes too
        long, ImageTooLargeError if it is too large, and ProtocolError if it is malformed.
        """
        charge = self._budget.charge(caller)
        try:
            yield await self._read_in_time(request, caller, charge)
        finally:
            charge.set(0)

    async def _read_in_time(self, request: Request, caller: str, charge: Charge) -> bytes:
        limits = self._limits
        if self._reading.total() >= limits.bodies or self._reading[caller] >= limits.bodies_per_caller:
            raise BusyError(f"{self._reading.total()} images are being received, which is the limit", "try again later")
        self._reading[caller] += 1
        try:
            async with asyncio.timeout(limits.body_s):
                return await self._read(request, charge)
        except TimeoutError:
            raise IdleError(
                f"the request was not complete after {limits.body_s:g} seconds", "send a smaller JPEG, or use a stream"
            ) from None
        finally:
            self._reading[caller] -= 1
            if not self._reading[caller]:
                del self._reading[caller]

    async def _read(self, request: Request, charge: Charge) -> bytes:
        if request.headers.get("content-type", "").lower().startswith("multipart/form-data"):
            return await self._read_form(request, charge)
        return b"".join([chunk async for chunk in _chunks(request, self._limits.max_bytes, charge)])

    async def _read_form(self, request: Request, charge: Charge) -> bytes:
        body = _chunks(request, self._limits.max_bytes + _MULTIPART_OVERHEAD, charge)
        parser = MultiPartParser(request.headers, body, max_files=1, max_fields=8)
        parser.spool_max_size = self._limits.max_bytes + 1
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


async def _chunks(request: Request, max_bytes: int, charge: Charge) -> AsyncGenerator[bytes]:
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
                charge.set(size)
                yield chunk
        except ClientDisconnect:
            raise ProtocolError("the client disconnected before the end of its request") from None
    if size > max_bytes:
        raise ImageTooLargeError(f"the request exceeds the limit of {max_bytes:,} bytes", "send a smaller JPEG")
