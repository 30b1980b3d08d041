"""The control interval of a log: how often its commands change, or else how often they are logged.

A table has a row every 10 ms though the loop that is recorded in it sends a command every 50 ms.
So the times between changes are asked first: nearly all must be multiples of one interval, and many
be that interval itself; a test signal that steps once a second says nothing of the loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded_trials.logs.inspect_guess import Guess
from grounded_trials.logs.inspect_log import LogReport
from grounded_trials.logs.signals import Series, SignalSpec, read_signals
from grounded_trials.starting.kinds import COMMANDED

RATES = (1000, 500, 400, 250, 200, 125, 120, 100, 60, 50, 40, 30, 25, 20, 15, 10, 5, 2)  # [Hz]
STEPS = tuple(float(f"{1 / rate:.6g}") for rate in RATES)  # [s], as it is written
GUESSED = 0.05  # [s]
LONGEST = 0.1  # [s]; what changes more rarely may be a test signal's steps
ENOUGH = 20  # times between changes
NEARLY_ALL = 0.95  # of them are multiples of the interval
ONCE = 0.25  # of them are the interval itself
APART = 1.5  # rows, from which an interval is another one than theirs
NEAR = 0.03  # of an interval: it is one of STEPS, whose rows come that nearly so often
OFF = 0.05  # of an interval, that the mean of the times between changes may be from it
MOSTLY, IN_STEP = 0.5, 0.6  # of times between changes, and of their phases, where a loop jitters
TOGETHER = 40  # changes whose phases are compared: clocks drift
EXACT, LOOSE = 0.1, 0.25  # of an interval: how far a multiple may be off it


def interval_of(
    report: LogReport, inputs: Sequence[Guess], states: Sequence[Guess]
) -> tuple[float, str, str]:
    """(the control interval [s], whose it is, a note where it is not that of the rows).

    Args:
        report: the log.
        inputs: where its commands are.
        states: where its states are.
    """
    inputs = _commanded(inputs)
    for guesses, whose in ((inputs, "log's commands"), (states, "log's states")):
        rates = [
            t.rate_hz for g in guesses if (t := _topic(report, g)) is not None and t.rate_hz > 0
        ]
        if not rates:
            continue
        rows = 1 / min(rates)
        held = _held(report, inputs, rows) if guesses is inputs else None
        if held is not None:
            note = (
                f"the log has its commands every {rows:.3g} s, but they change every {held:g} s: "
                "that is dt; --dt says otherwise"
            )
            return held, ": that in which the log's commands change", note
        return round_interval(rows), f": that of the {whose}", ""
    return GUESSED, ": a guess, no input or state was found", ""


def round_interval(rows: float) -> float:
    """The interval of a loop whose rows come so often [s]: of a usual rate, else of whole Hz or ms.

    It is not shorter than the shortest of `STEPS`, nor longer than the longest.
    """
    usual = min(STEPS, key=lambda step: abs(np.log(step / rows)))
    if abs(usual / rows - 1) < NEAR or not STEPS[0] < rows < STEPS[-1]:
        return usual
    whole = (1e-3 * max(round(1e3 * rows), 1), 1 / max(round(1 / rows), 1))
    nearest = min(whole, key=lambda step: abs(step - rows))
    return float(f"{nearest if abs(nearest / rows - 1) < NEAR else rows:.6g}")


def _held(report: LogReport, inputs: Sequence[Guess], rows: float) -> float | None:
    """The interval in which commands change that are logged more often; None: not to be told."""
    specs = {g.name: SignalSpec(g.path, clock=g.clock) for g in inputs if g.path}  # type: ignore[arg-type]
    try:
        found = read_signals(report.files, specs)
    except GroundedError:  # what is wrong with it is said where the run is sampled
        return None
    gaps = np.concatenate([_between_changes(one) for one in found.values()])
    return changes_every(gaps, rows)


def _between_changes(series: Series) -> Array:
    """The times between changes of a command [s]."""
    order = np.argsort(series.t, kind="stable")
    t, values = series.t[order], series.values[order]
    return np.asarray(np.diff(t[1:][np.diff(values) != 0]) * 1e-9)


def changes_every(gaps: Array, rows: float) -> float | None:
    """The interval of which nearly all times between changes are multiples; None for none.

    Args:
        gaps: those times [s].
        rows: the time between samples [s], by which each may be off.
    """
    if len(gaps) < ENOUGH:
        return None
    found: dict[float, float] = {}  # how far the mean is off each that will do
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
    """The interval of a loop whose jitter takes changes a row earlier or later; None for none.

    Times between them are then off by a row now and then, but the next ones make up for it.
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
    """The inputs; one that was not found at what is called a command among its rivals."""
    rivals = [next((p for p in g.others if COMMANDED.search(p.lower())), "") for g in inputs]
    return tuple(
        g if g.path else replace(g, path=path) for g, path in zip(inputs, rivals, strict=True)
    )


def _topic(report: LogReport, guess: Guess) -> Any:
    known = {t.topic: t for t in report.topics if guess.path.strip('"').startswith(t.topic)}
    return known[max(known, key=len)] if known and guess.path else None
