"""A limit on the bytes that peers make the service keep: messages in parts, frames that wait, bodies and pictures."""

from __future__ import annotations

from collections import Counter

from lanestream.errors import BusyError


class ByteBudget:
    """Allows `total` bytes for all callers together, and a quarter of them for each."""

    def __init__(self, total: int) -> None:
        self._total = total
        self._share = total // 4
        self._used = 0
        self._used_by: Counter[str] = Counter()

    @property
    def used(self) -> int:
        """The bytes in use now."""
        return self._used

    def charge(self, caller: str) -> Charge:
        """Returns a charge of 0 bytes on the account of `caller`."""
        return Charge(self, caller)

    def resize(self, caller: str, before: int, after: int) -> None:
        """Changes a charge. Raises BusyError, and changes nothing, if it would grow beyond a limit."""
        growth = after - before
        if growth > 0:
            if self._used_by[caller] + growth > self._share:
                raise BusyError(
                    f"your unanswered images and messages exceed {self._share:,} bytes",
                    "wait for answers, or send smaller images",
                )
            if self._used + growth > self._total:
                raise BusyError("the memory for images and messages is in use", "try again later")
        self._used += growth
        self._used_by[caller] += growth
        if not self._used_by[caller]:
            del self._used_by[caller]


class Charge:
    """Bytes that are kept for one caller."""

    def __init__(self, budget: ByteBudget, caller: str) -> None:
        self.caller = caller
        self._budget = budget
        self._size = 0

    def set(self, size: int) -> None:
        """Sets the number of bytes. Raises BusyError, and changes nothing, if it would grow beyond a limit."""
        if size != self._size:
            self._budget.resize(self.caller, self._size, size)
            self._size = size

    def shrink(self, amount: int) -> None:
        """Gives a part back, at most what is charged."""
        self.set(max(0, self._size - amount))
