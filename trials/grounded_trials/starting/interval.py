"""Estimates a log's control interval from how often its commands, or else states, are logged."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.starting.kinds import COMMANDED

RATES = (1000, 500, 400, 250, 200, 125, 120, 100, 60, 50, 40, 30, 25, 20, 15, 10, 5, 2)  # [Hz]
STEPS = tuple(float(f"{1 / rate:.6g}") for rate in RATES)  # [s], rounded as written to files
GUESSED = 0.05  # [s], if nothing is known
ROUNDING = 0.03  # relative tolerance for rounding to one of STEPS


def interval_of(report: LogReport, inputs: Sequence[Guess], states: Sequence[Guess]) -> float:
    """Estimate the control interval of a log [s].

    Args:
        report: the log.
        inputs: the paths of its commands.
        states: the paths of its states.
    """
    rivals = [next((p for p in g.others if COMMANDED.search(p.lower())), "") for g in inputs]
    sent = [one.path or rival for one, rival in zip(inputs, rivals, strict=True)]
    for paths in (sent, [one.path for one in states]):
        topics = [report.topic_of(path) for path in paths]
        rates = [topic.rate_hz for topic in topics if topic is not None and topic.rate_hz > 0]
        if rates:
            return round_interval(1 / min(rates))
    return GUESSED


def round_interval(rows: float) -> float:
    """Round the interval of a log's rows [s] to a usual rate, else to whole Hz or ms.

    It is at least the smallest of `STEPS`. Slow processes are logged every few seconds.
    """
    usual = min(STEPS, key=lambda step: abs(np.log(step / rows)))
    if abs(usual / rows - 1) < ROUNDING or not STEPS[0] < rows:
        return usual
    whole = 1e-3 * max(round(1e3 * rows), 1), 1 / max(round(1 / rows), 1)
    nearest = min(whole, key=lambda step: abs(step - rows))
    return float(f"{nearest if abs(nearest / rows - 1) < ROUNDING else rows:.6g}")
