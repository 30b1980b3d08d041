"""Estimates a log's control interval from how often its commands change, or else are logged.

A table may have a row every 10 ms although the recorded loop sends a command every 50 ms. So the
times between changes are examined first: nearly all must be multiples of one interval, and many
must equal it. A test signal that steps once a second says nothing about the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.signals import Series, SignalSpec, read_signals
from grounded_trials.starting.kinds import COMMANDED

RATES = (1000, 500, 400, 250, 200, 125, 120, 100, 60, 50, 40, 30, 25, 20, 15, 10, 5, 2)  # [Hz]
STEPS = tuple(float(f"{1 / rate:.6g}") for rate in RATES)  # [s], rounded as written to files
GUESSED = 0.05  # [s], if nothing is known
LONGEST = 0.1  # [s]; slower changes may be the steps of a test signal
SLOW = 0.95  # [s] from which an interval is rounded to whole seconds
ENOUGH = 20  # smallest number of times between changes
NEARLY_ALL = 0.95  # share of them that must be multiples of the interval
ONCE = 0.25  # share of them that must equal the interval
APART = 1.5  # smallest ratio of an interval to that of the rows
NEAR = 0.03  # relative tolerance for rounding to one of STEPS
OFF = 0.05  # relative tolerance of the mean time between changes
MOSTLY, IN_STEP = 0.5, 0.6  # for a loop that jitters: share of intervals, and phase coherence
TOGETHER = 40  # changes per block of phases, short because clocks drift
EXACT, LOOSE = 0.1, 0.25  # tolerance of a multiple, as a fraction of the interval


def interval_of(
    report: LogReport, inputs: Sequence[Guess], states: Sequence[Guess]
) -> tuple[float, Finding | None]:
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
        rates = [
            t.rate_hz for g in guesses if (t := _topic(report, g)) is not None and t.rate_hz > 0
        ]
        if not rates:
            continue
        rows = 1 / min(rates)
        held = _held(report, inputs, rows) if guesses is inputs else None
        if held is not None:
            return held, found("start.interval", every=held, dt=held, rows=rows)
        return round_interval(rows), None
    return GUESSED, None


def round_interval(rows: float) -> float:
    """Round the interval of a log's rows [s] to a usual rate, else to whole Hz, ms or seconds.

    It is at least the smallest of `STEPS`. Slow processes are logged every few seconds.
    """
    usual = min(STEPS, key=lambda step: abs(np.log(step / rows)))
    if abs(usual / rows - 1) < NEAR or not STEPS[0] < rows:
        return usual
    whole = [1e-3 * max(round(1e3 * rows), 1), 1 / max(round(1 / rows), 1)]
    if rows > SLOW:
        whole = [float(round(rows))]
    nearest = min(whole, key=lambda step: abs(step - rows))
    return float(f"{nearest if abs(nearest / rows - 1) < NEAR else rows:.6g}")


def too_coarse(report: LogReport, inputs: Sequence[Guess], dt: float) -> Finding | None:
    """Return a note if the commands of a log change more than once in a given interval.

    Args:
        report: the log.
        inputs: the paths of its commands.
        dt: the interval that the user asked for [s].
    """
    gaps = _gaps(report, _commanded(inputs))
    if len(gaps) < ENOUGH or dt < APART * (apart := float(np.median(gaps))):
        return None
    return found("start.interval", every=round_interval(apart), dt=dt)


def _held(report: LogReport, inputs: Sequence[Guess], rows: float) -> float | None:
    """Return the interval at which commands change if they are logged more often, else None."""
    return changes_every(_gaps(report, inputs), rows)


def _gaps(report: LogReport, inputs: Sequence[Guess]) -> Array:
    """Return the times between changes of a log's commands [s]; none if they can't be read."""
    specs = {g.name: SignalSpec(g.path, clock=g.clock) for g in inputs if g.path}  # type: ignore[arg-type]
    try:
        found = read_signals(report.files, specs, report.layout)
    except GroundedError:  # reported later, when the run is sampled
        return np.zeros(0)
    return np.concatenate([np.zeros(0), *map(_between_changes, found.values())])


def _between_changes(series: Series) -> Array:
    """Return the times between changes of a command [s]."""
    order = np.argsort(series.t, kind="stable")
    t, values = series.t[order], series.values[order]
    return np.asarray(np.diff(t[1:][np.diff(values) != 0]) * 1e-9)


def changes_every(gaps: Array, rows: float) -> float | None:
    """Return the interval of which nearly all times between changes are multiples, else None.

    Args:
        gaps: times between changes [s].
        rows: time between samples [s], the resolution of `gaps`.
    """
    if len(gaps) < ENOUGH:
        return None
    found: dict[float, float] = {}  # relative deviation of the mean, by possible interval
    for step in STEPS:
        if not APART * rows < step <= LONGEST:
            continue
        near = step * min(max(EXACT, 1.05 * rows / step), LOOSE)
        whole = np.maximum(np.rint(gaps / step), 1)
        on = np.abs(gaps - whole * step) <= near
        often = on.mean() >= NEARLY_ALL and (on & (whole == 1)).mean() >= ONCE
        if often:
            found[step] = abs(float((gaps / whole)[on].mean()) / step - 1)
    fits = [step for step, off in found.items() if off < OFF]
    if not fits:
        return _in_phase(gaps, rows)
    alike = [step for step in fits if step > max(fits) / (1 + 2 * OFF)]  # 120 and 125 Hz
    return min(alike, key=found.__getitem__)


def _in_phase(gaps: Array, rows: float) -> float | None:
    """Return the interval of a loop whose changes jitter by a row, else None.

    Single times between changes are then off by a row, but the phase of the changes stays the same.
    """
    changes, found = np.cumsum(gaps), dict[float, float]()
    parts = np.array_split(changes, max(1, len(changes) // TOGETHER))
    for step in STEPS:
        once = np.abs(gaps - step) <= LOOSE * step
        if APART * rows < step <= LONGEST and once.mean() >= MOSTLY:
            turns = [abs(np.exp(2j * np.pi * part / step).mean()) for part in parts]
            found[step] = float(np.median(turns))
    best = max(found, key=found.__getitem__, default=None)
    return best if best is not None and found[best] >= IN_STEP else None


def _commanded(inputs: Sequence[Guess]) -> tuple[Guess, ...]:
    """Return the inputs; one without a path gets that of a rival named like a command."""
    rivals = [next((p for p in g.others if COMMANDED.search(p.lower())), "") for g in inputs]
    return tuple(
        g if g.path else replace(g, path=path) for g, path in zip(inputs, rivals, strict=True)
    )


def _topic(report: LogReport, guess: Guess) -> Any:
    known = {t.topic: t for t in report.topics if guess.path.strip('"').startswith(t.topic)}
    return known[max(known, key=len)] if known and guess.path else None
