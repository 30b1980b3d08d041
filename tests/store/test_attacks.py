"""A little of each attack of `benchmarks/attack.py`, seeded."""

from __future__ import annotations

import random

import pytest

from benchmarks.attack import ATTACKS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seconds"), [("mutants", 0.3), ("configurations", 0.3), ("flips", 0.3)]
)
def test_a_little_of_each_attack_breaks_nothing(name: str, seconds: float) -> None:
    tally = ATTACKS[name](random.Random(5), seconds)
    assert tally.failures == [] and tally.tries > 0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seconds"), [("short writes", 1)])
def test_commands_that_are_attacked_break_nothing(name: str, seconds: float) -> None:
    tally = ATTACKS[name](random.Random(5), seconds)
    assert tally.failures == [] and tally.tries > 0
