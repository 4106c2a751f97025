"""The budget of bytes, in all and of one caller."""

from __future__ import annotations

import pytest

from lanestream.api.byte_budget import ByteBudget
from lanestream.errors import BusyError


def test_a_caller_gets_a_quarter_and_gives_it_back() -> None:
    budget = ByteBudget(400)
    first, second = budget.charge("a"), budget.charge("a")
    first.set(60)
    with pytest.raises(BusyError, match="exceed 100 bytes"):
        second.set(41)
    second.set(40)
    budget.charge("b").set(100)
    first.set(0)
    second.set(100)
    assert budget.used == 200


def test_all_callers_together_are_limited() -> None:
    budget = ByteBudget(400)
    charges = [budget.charge(caller) for caller in "abcde"]
    for charge in charges[:4]:
        charge.set(90)
    with pytest.raises(BusyError, match="is in use"):
        charges[4].set(41)
    charges[4].set(40)
    assert budget.used == 400


def test_a_charge_that_is_refused_stays_as_it_was_and_can_always_shrink() -> None:
    budget = ByteBudget(400)
    charge = budget.charge("a")
    charge.set(100)
    with pytest.raises(BusyError):
        charge.set(101)
    charge.set(99)
    assert budget.used == 99
    charge.set(0)
    assert budget.used == 0
