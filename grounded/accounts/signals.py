"""Checks of one signal on its own: samples that repeat, drop out, jump or clip; and of commands.

Commands may be copies of one another, constant within a trial, at or beyond their limits. If logged
ones exceed the limits, the limits are too narrow: limits taken from one log are those of that run,
not of the robot. Plans stay within them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from grounded.accounts.finding import Finding
from grounded.accounts.lag import LEAST_S, REPORTED_FROM, lag_between
from grounded.accounts.table import OVER
from grounded.findings import Quantity, found
from grounded.frozen import Array, white_noise
from grounded.model import Model
from grounded.places import integrals
from grounded.result import extent
from grounded.task import Task
from grounded.trial import Trial

STUCK = 8  # equal samples before a jump
UNMOVED, SMALL_RATE = 8.0, 0.03  # range of noise, and share of the largest rate, that are rest
HELD = 0.8  # share of runs longer than one sample, above which the sensor is slower than the log
COARSE = 0.7  # of the rms change from sample to sample: a larger quantum is reported
CLIPPED = 0.02  # share of samples above which clipping is reported
FEWEST = 20  # changes from sample to sample that are needed
FULL_TURNS = (2 * np.pi, 360.0)
OFTEN = 0.1  # share of the time above which commands at their limits are reported
COPY, MAYBE = 0.99, 0.5  # coherence, and correlation, of two identical inputs
PERCENT_FROM = 20.0  # times the limit: a value in percent exceeds it by more
ROUNDED = 0.01  # of the largest command: an excess below this is rounding


@dataclass(frozen=True, eq=False)
class Signal:
    """One state of all trials.

    Args:
        name: of the state.
        unit: of the state.
        angle: whether its differences wrap.
        columns: its samples in each trial (T + 1,), NaN where missing.
        dt: time step [s].
        moves: where it is not known to be at rest, in each trial (T + 1,).
    """

    name: str
    unit: str
    angle: bool
    columns: Sequence[Array]
    dt: float
    moves: Sequence[Any]

    @property
    def changes(self) -> Array:
        """The sizes of all changes from sample to sample, without zeros."""
        d = np.concatenate([np.abs(np.diff(x)) for x in self.columns])
        return np.asarray(d[np.isfinite(d) & (d > 0)])

    def told(
        self, kind: str, part: float = np.nan, /, *, mended: bool = False, **facts: Any
    ) -> Finding:
        """Return a finding on its samples."""
        said = found("sensor.samples", self.name, **facts)
        return Finding(self.name, said, kind, share=part, corrected=mended)

    def without(self, gone: Sequence[Any]) -> Signal:
        """Return the signal with some samples missing."""
        pairs = zip(self.columns, gone, strict=True)
        return replace(self, columns=[np.where(g, np.nan, x) for x, g in pairs])


Found = tuple[Finding, Signal]


def signal_of(model: Model, trials: Sequence[Trial], i: int, shown: Sequence[int]) -> Signal:
    """Return state i of some trials; the states `shown` have sensors."""
    name, units = model.state_names[i], list(model.states.values())
    places = [one.i for one in integrals(model) if one.j == i and one.i in shown]
    if not places and units[i].endswith("/s"):
        places = [k for k in shown if not units[k].endswith("/s")]
    moves = [~_at_rest(trial.states, i, places) for trial in trials]
    columns = [trial.states[:, i] for trial in trials]
    return Signal(name, units[i], bool(model.angle_mask[i]), columns, trials[0].dt, moves)


def judge_signal(signal: Signal) -> tuple[list[Finding], Signal]:
    """Return the findings of a signal, and the corrected signal."""
    findings = [one for note in (_missing, _quantised, _clipped) if (one := note(signal))]
    for look in (_wrapped, _dropouts, _held, _stuck):
        if seen := look(signal):
            findings.append(seen[0])
            signal = seen[1]
    return findings, signal


def runs(x: Array) -> tuple[Any, Any]:
    """Return starts and lengths of the runs of equal samples in x (T,); NaN equals nothing."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]]))
    return edges[:-1], np.diff(edges)


def _at_rest(x: Array, i: int, places: Sequence[int]) -> Any:
    """Return where velocity i of a trial (T + 1, n) keeps a value near 0 and no position moves.

    Such data is valid: an encoder stays on one count while a joint sticks, and the wheels of a
    rover at a wall stand still, whatever its camera's noise.
    """
    rest, own = np.zeros(len(x), bool), x[:, i]
    least = UNMOVED * white_noise(x[:, places])
    small = SMALL_RATE * float(np.nanmax(np.abs(own), initial=0.0))
    for start, length in zip(*runs(own), strict=True):
        stay = slice(start, start + length)
        if places and length >= STUCK and abs(own[start]) <= small:
            rest[stay] = bool((np.ptp(x[stay][:, places], axis=0) <= least).all())
    return rest


def _share(gone: Sequence[Any]) -> float:
    return float(np.concatenate(list(gone)).mean())


def _wrapped(s: Signal) -> Found | None:
    """Find jumps by a full turn, in radians or degrees, in an angle that should be in radians."""
    for turn in FULL_TURNS if s.unit == "rad" else ():
        steps = [np.diff(x) for x in s.columns]
        jumps = [np.sign(d) * (np.abs(np.abs(d) - turn) < 0.1 * turn) for d in steps]
        jumps = [np.nan_to_num(k) for k in jumps]
        count, degrees = int(sum(np.abs(k).sum() for k in jumps)), turn == 360.0
        if not count or np.quantile(s.changes, 0.9) > 0.2 * turn or (s.angle and not degrees):
            continue
        whole = [
            (x - turn * np.concatenate([[0.0], np.cumsum(k)])) * (2 * np.pi / turn)
            for x, k in zip(s.columns, jumps, strict=True)
        ]
        one = s.told("degrees" if degrees else "wrapped", mended=True, degrees=degrees, count=count)
        keys: dict[str, Any] = {"scale": 0.017453293} if degrees else {}
        scale = 180 / np.pi if degrees else 1.0
        return replace(one, scale=scale, keys=keys | {"unwrap": True}), replace(s, columns=whole)
    return None


def _dropouts(s: Signal) -> Found | None:
    """Find a fixed value that the signal jumps to for single samples."""
    if s.changes.size < FEWEST:
        return None
    far, values = 10 * float(np.quantile(s.changes, 0.9)), []
    for x in s.columns:
        there = (np.abs(x[1:-1] - x[:-2]) > far) & (np.abs(x[1:-1] - x[2:]) > far)
        values += list(x[1:-1][there & (np.abs(x[2:] - x[:-2]) < far)])
    known, counts = np.unique(values, return_counts=True)
    if not len(known) or counts.max() < 3:
        return None
    value = float(known[np.argmax(counts)])
    gone = [
        (x == value) & ((np.abs(x - np.roll(x, 1)) > far) | (np.abs(x - np.roll(x, -1)) > far))
        for x in s.columns
    ]
    share = _share(gone)
    return s.told("dropout", share, mended=True, low=f"{value:g}", share=share), s.without(gone)


def _held(s: Signal) -> Found | None:
    """Find a signal that repeats every value: the sensor or its topic is slower than the log."""
    lengths, gone = list[int](), list[Any]()
    for x in s.columns:
        start, length = runs(x)
        lengths += list(length[np.isfinite(np.diff(x[start], append=np.nan))])
        gone.append(np.isfinite(x) & ~np.isin(np.arange(len(x)), start))
    if len(lengths) < FEWEST or not s.changes.size:
        return None
    coarse = np.quantile(s.changes, 0.5) < 2.5 * s.changes.min()  # coarse quantisation
    if coarse or np.mean(np.array(lengths) >= 2) < HELD:
        return None
    one = s.told("held", _share(gone), mended=True, every=float(np.median(lengths)) * s.dt)
    return replace(one, mend=one.said), s.without(gone)


def _stuck(s: Signal) -> Found | None:
    """Find a value that stays exactly constant and then jumps to the true one."""
    if s.changes.size < FEWEST:
        return None
    far, gone, longest = 2 * float(np.median(s.changes)), [], 0
    for x, moves in zip(s.columns, s.moves, strict=True):
        flat = np.zeros(len(x), bool)
        for start, length in zip(*runs(x), strict=True):
            end = start + length
            if length < STUCK or not start or end >= len(x) or moves[start:end].sum() < STUCK:
                continue
            onward = abs(x[end + 1] - x[end]) if end + 1 < len(x) else np.inf
            if abs(x[end] - x[start]) > max(far, 3 * onward):
                flat[start + 1 : end] = True
                longest = max(longest, int(length))
        gone.append(flat)
    if not longest:
        return None
    return s.told("stuck", _share(gone), mended=True, stuck=longest * s.dt), s.without(gone)


def _missing(s: Signal) -> Finding | None:
    """Find missing samples before the last one that is there."""
    last = [np.flatnonzero(np.isfinite(x))[-1:] for x in s.columns]
    gone = [~np.isfinite(x[: k[0] + 1]) for x, k in zip(s.columns, last, strict=True) if len(k)]
    if not any(g.any() for g in gone):
        return None
    lost = [length[g[start]] for g in gone for start, length in [runs(g.astype(float))]]
    share, longest = _share(gone), float(np.concatenate(lost).max())
    return s.told("missing", share, gap=longest * s.dt, share=share)


def quantum(columns: Sequence[Array]) -> float:
    """Return the quantum of which all values are integer multiples; 0.0 if there is none."""
    values = np.unique(np.concatenate([x[np.isfinite(x)] for x in columns]))
    gaps = np.diff(values)
    gaps = gaps[gaps > 1e-9 * max(float(np.abs(values).max(initial=0.0)), 1e-300)]
    if gaps.size < 3:
        return 0.0
    small = gaps[gaps < 1.5 * gaps.min()]
    step = float(np.median(small))
    whole = np.abs(gaps / step - np.rint(gaps / step)) < 0.02 * np.maximum(np.rint(gaps / step), 1)
    return step if len(small) > 0.2 * len(gaps) and whole.mean() > 0.95 else 0.0


def _quantised(s: Signal) -> Finding | None:
    """Find a quantisation as coarse as the changes between samples."""
    step, d = quantum(s.columns), np.concatenate([np.diff(x) for x in s.columns])
    if not step or step < COARSE * np.sqrt(np.mean(d[np.isfinite(d)] ** 2)):
        return None
    return s.told("quantised", step=Quantity(step, s.unit))


def _clipped(s: Signal) -> Finding | None:
    """Find an extreme value that is reached at speed and held for several samples, repeatedly."""
    values = np.concatenate([x[np.isfinite(x)] for x in s.columns])
    if s.changes.size < FEWEST or quantum(s.columns):
        return None
    for limit, side in ((values.max(), "above"), (values.min(), "below")):
        stays = list[int]()
        for x, moves in zip(s.columns, s.moves, strict=True):
            start, length = runs(x)
            stays += list(length[(x[start] == limit) & (length >= 3) & (start > 0) & moves[start]])
        share = sum(stays) / values.size
        if len(stays) >= 3 and share > CLIPPED:
            at = f"{limit:.4g} {s.unit}"
            said = found("sensor.limits", s.name, side=side, limit=at, share=share)
            return Finding(s.name, said, "saturated", share=share)
    return None


# --- commands -------------------------------------------------------------------------------------


def beyond_limits(task: Task, inputs: Array) -> Array:
    """Return by how much each command (T, m) exceeds its limits, in its unit; 0 inside them.

    Args:
        task: with the limits.
        inputs: the commands (T, m) of a log; NaN counts as 0.
    """
    inputs = np.nan_to_num(inputs)
    excess = np.maximum(task.low - inputs, inputs - task.high)
    slack = ROUNDED * np.abs(inputs).max(axis=0, initial=0.0)
    return np.asarray(np.where(excess > slack, excess, 0.0))


def judge_limits(task: Task, inputs: Array) -> Iterator[Finding]:
    """Yield a finding for each command (T, m) that is often beyond or at its limits."""
    past = beyond_limits(task, inputs) > 0
    at = ((inputs <= task.low) | (inputs >= task.high)) & ~past
    for j, name in enumerate(task.model.input_names):
        share = float(past[:, j].mean())
        if share > OFTEN:
            said = found(
                "sensor.limits",
                name,
                limits=limits_of(task, j),
                share=share,
                logged=span(inputs[:, j]),
                how="percent" if in_percent(task, inputs, j) else "widen",
            )
            yield Finding(name, said, "beyond", share=share, mend=said)
        share = float(at[:, j].mean())
        if share > OFTEN:
            said = found("sensor.limits", name, at=True, share=share)
            yield Finding(name, said, "saturated", share=share)


def in_percent(task: Task, inputs: Array, j: int) -> bool:
    """Return whether a dimensionless input seems to be logged in percent.

    Args:
        task: with the limits.
        inputs: the commands (T, m) of a log.
        j: the input.
    """
    unit = list(task.model.inputs.values())[j]
    most = float(np.nanmax(np.abs(inputs[:, j]), initial=0.0))
    limit = float(max(abs(task.low[j]), abs(task.high[j])))
    return unit == "1" and PERCENT_FROM * limit < most <= 100 * OVER


def limits_of(task: Task, j: int) -> str:
    """Return an input's limits as text, such as `0 to 1.17 m/s`."""
    unit = task.model.inputs[task.model.input_names[j]]
    return f"{span(np.array([task.low[j], task.high[j]]))}{'' if unit == '1' else f' {unit}'}"


def span(values: Array) -> str:
    """Return the range of all values as text, such as `-1.2 to 2.15`."""
    low, high = extent(float(np.nanmin(values)), float(np.nanmax(values)))
    return f"{low:.4g} to {high:.4g}"


def judge_inputs(subject: Task | Model, trials: Sequence[Trial]) -> Iterator[Finding]:
    """Yield the findings of commands: copies, limits, inputs that are constant in each trial."""
    names = trials[0].input_names
    columns = [[trial.inputs[:, j] for trial in trials] for j in range(len(names))]
    fixed = [all(np.ptp(x) == 0 for x in some) for some in columns]
    for j in np.flatnonzero(fixed):
        values = sorted({float(x[0]) for x in columns[j]})
        if len(values) > 1:
            shown = tuple(f"{v:.4g}" for v in values[:6])
            yield Finding(names[j], found("sensor.same", names[j], values=shown), "constant")
    if isinstance(subject, Task):
        yield from judge_limits(subject, np.concatenate([trial.inputs for trial in trials]))
    longest = max(trials, key=lambda trial: trial.steps).inputs
    moving = [j for j in range(len(names)) if np.ptp(longest[:, j]) > 0]
    close = np.abs(np.corrcoef(longest, rowvar=False)) if len(moving) > 1 else np.zeros((0, 0))
    for pair in (pair for pair in combinations(moving, 2) if close[pair] > MAYBE):
        lag = lag_between(list(zip(*(columns[j] for j in pair), strict=True)), trials[0].dt)
        if lag is not None and lag.coherence > COPY and 0.9 < lag.sign * lag.low < 1.1:
            # perhaps a command and its measurement
            first, second = (names[j] for j in (pair if lag.delay >= 0 else pair[::-1]))
            d = abs(lag.delay)
            late = d if d > max(REPORTED_FROM * lag.std, LEAST_S) else None
            said = found("sensor.same", second, of=first, late=late)
            yield Finding(second, said, "copy", d, lag.std, lag.low)
