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
from grounded.accounts.lag import LEAST_S, REPORTED_FROM, Lag, lag_between
from grounded.accounts.table import OVER
from grounded.findings import Quantity, found
from grounded.frozen import Array, white_noise
from grounded.model import Model
from grounded.places import integrals
from grounded.result import extent
from grounded.task import Task
from grounded.trial import Trial

STUCK = 8  # equal samples before a jump
JUMP = 3.0  # the jump, relative to the change that follows
UNMOVED, SMALL_RATE = 8.0, 0.03  # range of noise, and share of the largest rate, that are rest
HELD = 0.8  # share of runs longer than one sample, above which the sensor is slower than the log
COARSE = 0.7  # of the rms change from sample to sample: a larger quantum is reported
CLIPPED = 0.02  # share of samples above which clipping is reported
FULL_TURNS = (2 * np.pi, 360.0)
OFTEN = 0.1  # share of the time above which it is reported
COPY = 0.99  # coherence of two identical inputs: two motors of one vehicle have 0.96
MAYBE = 0.5  # correlation of two inputs that may be copies
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
        rests: for a velocity, where it and its position are at rest, in each trial (T + 1,).
    """

    name: str
    unit: str
    angle: bool
    columns: Sequence[Array]
    dt: float
    rests: Sequence[Any] = ()

    def without(self, gone: Sequence[Any]) -> Signal:
        """Return the signal with some samples missing."""
        pairs = zip(self.columns, gone, strict=True)
        return replace(self, columns=[np.where(g, np.nan, x) for x, g in pairs])

    def moving(self) -> list[Any]:
        """Return where it is not known to be at rest, in each trial (T + 1,)."""
        if len(self.rests):
            return [~np.asarray(rest) for rest in self.rests]
        return [np.ones(len(x), bool) for x in self.columns]


Found = tuple[Finding, Signal]


def signal_of(model: Model, trials: Sequence[Trial], i: int, shown: Sequence[int]) -> Signal:
    """Return state i of some trials; the states `shown` have sensors."""
    name, dt, rests = model.state_names[i], trials[0].dt, list[Any]()
    columns = [trial.states[:, i] for trial in trials]
    for one in integrals(model):
        if one.j == i and one.i in shown:
            rests = at_rest([t.states[:, one.i] for t in trials], [one.c * w for w in columns], dt)
    if not rests and model.states[name].endswith("/s"):
        places = [k for k in shown if not list(model.states.values())[k].endswith("/s")]
        rests = [_unmoved(trial.states, i, places) for trial in trials] if places else []
    return Signal(name, model.states[name], bool(model.angle_mask[i]), columns, dt, rests)


def judge_signal(signal: Signal) -> tuple[list[Finding], Signal]:
    """Return the findings of a signal, and the corrected signal."""
    findings = [one for note in (_missing, _quantised, _clipped) if (one := note(signal))]
    for look in (_wrapped, _dropouts, _held, _stuck):
        found = look(signal)
        if found is not None:
            findings.append(found[0])
            signal = found[1]
    return findings, signal


def runs(x: Array) -> tuple[Any, Any]:
    """Return starts and lengths of the runs of equal samples in x (T,); NaN equals nothing."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]]))
    return edges[:-1], np.diff(edges)


def at_rest(position: Sequence[Array], velocity: Sequence[Array], dt: float) -> list[Any]:
    """Return where the position (T,) of each trial is exactly constant and its velocity agrees.

    Such data is valid: an encoder stays on one count while a joint sticks, and a filtered
    difference of it decays to 0. It is not at rest if the velocity implies more than half of a
    typical change of the position in that time.
    """
    usual, found = _changes(position), []
    count = float(np.median(usual)) if usual.size else 0.0
    for q, w in zip(position, velocity, strict=True):
        rest = np.zeros(len(q), bool)
        for start, length in zip(*runs(q), strict=True):
            if length >= STUCK:
                stay = slice(start, start + length)
                rest[stay] = np.abs(w[stay]) * length * dt <= 0.5 * count
        found.append(rest)
    return found


def _unmoved(x: Array, i: int, places: Sequence[int]) -> Any:
    """Return where velocity i of a trial (T + 1, n) keeps a value near 0 and no position moves.

    The wheels of a rover at a wall stand still, whatever its camera's noise.
    """
    rest, own = np.zeros(len(x), bool), x[:, i]
    least = UNMOVED * white_noise(x[:, places])
    small = SMALL_RATE * float(np.nanmax(np.abs(own), initial=0.0))
    for start, length in zip(*runs(own), strict=True):
        stay = slice(start, start + length)
        if length >= STUCK and abs(own[start]) <= small:
            rest[stay] = bool((np.ptp(x[stay][:, places], axis=0) <= least).all())
    return rest


def _changes(columns: Sequence[Array]) -> Any:
    """Return the sizes of all nonzero changes from sample to sample."""
    d = np.concatenate([np.abs(np.diff(x)) for x in columns])
    return d[np.isfinite(d) & (d > 0)]


def _wrapped(s: Signal) -> Found | None:
    """Find jumps by a full turn, in radians or degrees, in an angle that should be in radians."""
    if s.unit != "rad":
        return None
    for turn in FULL_TURNS:
        jumps = [np.abs(np.abs(np.diff(x)) - turn) < 0.1 * turn for x in s.columns]
        count, usual = sum(int(j.sum()) for j in jumps), _changes(s.columns)
        degrees = turn == 360.0
        if count == 0 or np.quantile(usual, 0.9) > 0.2 * turn or (s.angle and not degrees):
            continue
        whole = []
        for x in s.columns:
            steps = np.diff(x)
            off = np.where(np.abs(np.abs(steps) - turn) < 0.1 * turn, np.sign(steps), 0.0)
            whole.append((x - turn * np.concatenate([[0.0], np.cumsum(off)])) * (2 * np.pi / turn))
        said = found("sensor.samples", s.name, degrees=degrees, count=count)
        keys: dict[str, Any] = {"scale": 0.017453293} if degrees else {}
        kind, scale = ("degrees", 180 / np.pi) if degrees else ("wrapped", 1.0)
        keys["unwrap"] = True
        finding = Finding(s.name, said, kind, scale=scale, corrected=True, keys=keys)
        return finding, replace(s, columns=whole)
    return None


def _share(gone: Sequence[Any]) -> float:
    return float(np.concatenate(list(gone)).mean())


def _dropouts(s: Signal) -> Found | None:
    """Find a fixed value that the signal jumps to for single samples."""
    usual = _changes(s.columns)
    if usual.size < 20:
        return None
    far, values = 10 * float(np.quantile(usual, 0.9)), []
    for x in s.columns:
        there = (np.abs(x[1:-1] - x[:-2]) > far) & (np.abs(x[1:-1] - x[2:]) > far)
        near = np.abs(x[2:] - x[:-2]) < far
        values += list(x[1:-1][there & near])
    known, counts = np.unique(values, return_counts=True)
    if not len(known) or counts.max() < 3:
        return None
    value = float(known[np.argmax(counts)])
    gone = []
    for x in s.columns:
        before, after = np.roll(x, 1), np.roll(x, -1)
        gone.append((x == value) & ((np.abs(x - before) > far) | (np.abs(x - after) > far)))
    share = _share(gone)
    said = found("sensor.samples", s.name, low=f"{value:g}", share=share)
    return Finding(s.name, said, "dropout", share=share, corrected=True), s.without(gone)


def _held(s: Signal) -> Found | None:
    """Find a signal that repeats every value: the sensor or its topic is slower than the log."""
    lengths, sizes = [], _changes(s.columns)
    for x in s.columns:
        start, length = runs(x)
        moves = np.abs(np.diff(x[start], append=np.nan))
        lengths += list(length[np.isfinite(moves)])
    if len(lengths) < 20 or sizes.size == 0:
        return None
    coarse = float(np.quantile(sizes, 0.5)) < 2.5 * float(sizes.min())  # coarse quantisation
    if coarse or np.mean(np.array(lengths) >= 2) < HELD:
        return None
    each = float(np.median(lengths))
    gone = []
    for x in s.columns:
        old = np.ones(len(x), bool)
        old[runs(x)[0]] = False
        gone.append(old & np.isfinite(x))
    said = found("sensor.samples", s.name, every=each * s.dt)
    one = Finding(s.name, said, "held", share=_share(gone), corrected=True, mend=said)
    return one, s.without(gone)


def _stuck(s: Signal) -> Found | None:
    """Find a value that stays exactly constant and then jumps to the true one."""
    usual = _changes(s.columns)
    if usual.size < 20:
        return None
    far, gone, longest = 2 * float(np.median(usual)), [], 0
    for x, moves in zip(s.columns, s.moving(), strict=True):
        flat, (starts, lengths) = np.zeros(len(x), bool), runs(x)
        long = lengths >= STUCK
        for start, length in zip(starts[long], lengths[long], strict=True):
            end = start + length
            onward = abs(x[end + 1] - x[end]) if end + 1 < len(x) else np.inf
            jumps = end < len(x) and abs(x[end] - x[start]) > max(far, JUMP * onward)
            moved = start > 0 and x[start - 1] != x[start]
            if jumps and moved and moves[start:end].sum() >= STUCK:
                flat[start + 1 : end] = True
                longest = max(longest, int(length))
        gone.append(flat)
    if not longest:
        return None
    said = found("sensor.samples", s.name, stuck=longest * s.dt)
    return Finding(s.name, said, "stuck", share=_share(gone), corrected=True), s.without(gone)


def _missing(s: Signal) -> Finding | None:
    """Find missing samples before the last one that is there."""
    last = [np.flatnonzero(np.isfinite(x))[-1:] for x in s.columns]
    gone = [~np.isfinite(x[: k[0] + 1]) for x, k in zip(s.columns, last, strict=True) if len(k)]
    if not gone:
        return None
    share = _share(gone)
    if share == 0:
        return None
    longest = 0
    for g in gone:
        start, length = runs(g.astype(float))
        longest = max([longest, *length[g[start]]])
    said = found("sensor.samples", s.name, gap=longest * s.dt, share=share)
    return Finding(s.name, said, "missing", share=share)


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
    step = quantum(s.columns)
    d = np.concatenate([np.diff(x) for x in s.columns])
    rms = float(np.sqrt(np.nanmean(d**2))) if np.isfinite(d).any() else 0.0
    if step == 0 or step < COARSE * rms:
        return None
    said = found("sensor.samples", s.name, step=Quantity(step, s.unit))
    return Finding(s.name, said, "quantised")


def _clipped(s: Signal) -> Finding | None:
    """Find an extreme value that is reached at speed and held for several samples, repeatedly."""
    values = np.concatenate([x[np.isfinite(x)] for x in s.columns])
    usual = _changes(s.columns)
    if values.size < 50 or usual.size < 20 or quantum(s.columns):
        return None
    for limit, side in ((values.max(), "above"), (values.min(), "below")):
        stays, samples = 0, 0
        for x, moves in zip(s.columns, s.moving(), strict=True):
            start, length = runs(x)
            at = (x[start] == limit) & (length >= 3) & (start > 0) & moves[start]
            stays, samples = stays + int(at.sum()), samples + int(length[at].sum())
        share = samples / values.size
        if stays >= 3 and share > CLIPPED:
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
    for j, name in enumerate(names):
        values = sorted({float(x[0]) for x in columns[j]})
        if fixed[j] and len(values) > 1:
            shown = tuple(f"{v:.4g}" for v in values[:6])
            yield Finding(name, found("sensor.same", name, values=shown), "constant")
    if isinstance(subject, Task):
        yield from judge_limits(subject, np.concatenate([trial.inputs for trial in trials]))
    longest = max(trials, key=lambda trial: trial.steps).inputs
    moving = [j for j in range(len(names)) if not fixed[j] and np.ptp(longest[:, j]) > 0]
    close = np.abs(np.corrcoef(longest, rowvar=False)) if len(moving) > 1 else np.zeros((0, 0))
    for i, j in (pair for pair in combinations(moving, 2) if close[pair] > MAYBE):
        lag = lag_between(list(zip(columns[i], columns[j], strict=True)), trials[0].dt)
        if lag is not None and lag.coherence > COPY and 0.9 < lag.sign * lag.low < 1.1:
            yield _copy(names[i], names[j], lag)


def _copy(first: str, second: str, lag: Lag) -> Finding:
    """Return the finding of two inputs with one signal, perhaps a command and its measurement."""
    if lag.delay < 0:
        first, second = second, first
    d = abs(lag.delay)
    late = d if d > max(REPORTED_FROM * lag.std, LEAST_S) else None
    said = found("sensor.same", second, of=first, late=late)
    return Finding(second, said, "copy", d, lag.std, lag.low)
