"""The torture of `reliability.py`, with fewer repetitions (all of them: GROUNDED_TORTURE=1)."""

from __future__ import annotations

import os

import pytest

import reliability
from reliability import Outcome

FULL = os.environ.get("GROUNDED_TORTURE") == "1"


def fine(outcome: Outcome | None, why_not: str = "") -> None:
    if outcome is None:
        pytest.skip(why_not)
    assert outcome.tries > 0
    assert outcome.failures == ()


def test_every_truncation_is_refused() -> None:
    fine(reliability.read_damaged(flips=False))


@pytest.mark.slow
def test_every_flipped_bit_is_refused() -> None:
    fine(reliability.read_damaged(flips=True, stride=1 if FULL else 41))


def test_what_is_recovered_of_a_truncated_trial_is_right() -> None:
    fine(reliability.recover_damaged(flips=False, stride=1 if FULL else 41))


@pytest.mark.slow
def test_what_is_recovered_of_a_flipped_trial_is_right() -> None:
    fine(reliability.recover_damaged(flips=True, stride=1 if FULL else 149))


def test_verify_finds_every_flipped_bit() -> None:
    fine(reliability.verify_flips(stride=1 if FULL else 17))


@pytest.mark.slow
def test_kill_at_any_moment() -> None:
    fine(reliability.kills(300 if FULL else 3))


def test_concurrent_processes() -> None:
    fine(reliability.concurrent(24, 12) if FULL else reliability.concurrent(8, 4))


def test_a_write_that_ends_early() -> None:
    fine(reliability.size_limit(20_011 if FULL else 70_001))


def test_a_folder_that_may_not_be_written() -> None:
    fine(reliability.read_only())


@pytest.mark.slow
def test_faults_at_each_system_call() -> None:
    fine(reliability.fault_injection(1 if FULL else 19), "strace is not there")
