"""Estimates a log's control interval from how often its commands change, or else are logged.

A table may have a row every 10 ms although the recorded loop sends a command every 50 ms. So the
times between changes are examined first: of the usual intervals in which many of them pass, the one
at whose multiples commands change. A test signal that steps once a second says nothing about the
loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded_trials.logs.command_steps import changes_of
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.starting.kinds import COMMANDED

RATES = (1000, 500, 400, 250, 200, 125, 120, 100, 60, 50, 40, 30, 25, 20, 15, 10, 5, 2)  # [Hz]
STEPS = tuple(float(f"{1 / rate:.6g}") for rate in RATES)  # [s], rounded as written to files
GUESSED = 0.05  # [s], if nothing is known
LONGEST = 0.1  # [s]; slower changes may be the steps of a test signal
WHOLE_SECONDS_FROM = 0.95  # [s] from which an interval is rounded to whole seconds
FEWEST_TIMES = 20  # smallest number of times between changes
APART = 1.5  # smallest ratio of an interval to that of the rows
ROUNDING = 0.03  # relative tolerance for rounding to one of STEPS
ONCE, WITHIN = 0.25, 0.25  # share of times between changes that are the interval, within a part
IN_STEP, TOGETHER = 0.6, 40  # coherence of the phases of so many changes, since clocks drift


def interval_of(
    report: LogReport, inputs: Sequence[Guess], states: Sequence[Guess]
) -> tuple[float, tuple[Finding, ...]]:
    """Estimate the control interval of a log.

    Args:
        report: the log.
        inputs: the paths of its commands.
        states: the paths of its states.

    Returns:
        The interval [s], and a note if it differs from that of the rows.
    """
    inputs = _commanded(inputs)
    for guesses in (inputs, states):
        topics = [report.topic_of(one.path) for one in guesses]
        rates = [topic.rate_hz for topic in topics if topic is not None and topic.rate_hz > 0]
        if rates:
            rows = 1 / min(rates)
            held = changes_every(_gaps(report, inputs), rows) if guesses is inputs else None
            if held is None:
                return round_interval(rows), ()
            return held, (found("start.interval", every=held, dt=held, rows=rows),)
    return GUESSED, ()


def round_interval(rows: float) -> float:
    """Round the interval of a log's rows [s] to a usual rate, else to whole Hz, ms or seconds.

    It is at least the smallest of `STEPS`. Slow processes are logged every few seconds.
    """
    usual = min(STEPS, key=lambda step: abs(np.log(step / rows)))
    if abs(usual / rows - 1) < ROUNDING or not STEPS[0] < rows:
        return usual
    whole = [1e-3 * max(round(1e3 * rows), 1), 1 / max(round(1 / rows), 1)]
    if rows > WHOLE_SECONDS_FROM:
        whole = [float(round(rows))]
    nearest = min(whole, key=lambda step: abs(step - rows))
    return float(f"{nearest if abs(nearest / rows - 1) < ROUNDING else rows:.6g}")


def _gaps(report: LogReport, inputs: Sequence[Guess]) -> Array:
    """Return the times between changes of a log's commands [s]; none if they can't be read."""
    specs = {g.name: SignalSpec(g.path, clock=g.clock) for g in inputs if g.path}  # type: ignore[arg-type]
    try:
        found = read_signals(report.files, specs, report.layout)
    except GroundedError:  # reported later, when the run is sampled
        return np.zeros(0)
    changes = [changes_of(one.t, one.values)[0] for one in found.values()]
    return np.concatenate([np.zeros(0), *(1e-9 * np.diff(times) for times in changes)])


def changes_every(gaps: Array, rows: float) -> float | None:
    """Return the interval at whose multiples commands change, None if there is no such.

    Args:
        gaps: times between changes [s].
        rows: time between samples [s], the resolution of `gaps`.
    """
    if len(gaps) < FEWEST_TIMES:
        return None
    changes, coherence = np.cumsum(gaps), dict[float, float]()
    blocks = np.array_split(changes, max(1, len(changes) // TOGETHER))
    for step in STEPS:
        once = np.abs(gaps - step) <= WITHIN * step
        if APART * rows < step <= LONGEST and once.mean() >= ONCE:
            turns = [abs(np.exp(2j * np.pi * block / step).mean()) for block in blocks]
            coherence[step] = float(np.median(turns))
    best = max(coherence, key=coherence.__getitem__, default=None)
    return best if best is not None and coherence[best] >= IN_STEP else None


def _commanded(inputs: Sequence[Guess]) -> tuple[Guess, ...]:
    """Return the inputs; one without a path gets that of a rival named like a command."""
    rivals = [next((p for p in g.others if COMMANDED.search(p.lower())), "") for g in inputs]
    return tuple(
        g if g.path else replace(g, path=path) for g, path in zip(inputs, rivals, strict=True)
    )
