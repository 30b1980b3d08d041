"""Checks of one signal on its own: samples that repeat, drop out, stick or jump by a turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.accounts.finding import Finding
from grounded.accounts.levels import FEWEST_SAMPLES, NEARLY_ALL, STEPS_TO_JUDGE
from grounded.findings import found
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

FULL_TURNS = (2 * np.pi, 360.0)


@dataclass(frozen=True, eq=False)
class Signal:
    """One state of all trials.

    Args:
        name: of the state.
        unit: of the state.
        angle: whether its differences wrap.
        columns: its samples in each trial (T + 1,), NaN where missing.
        dt: time step [s].
    """

    name: str
    unit: str
    angle: bool
    columns: Sequence[Array]
    dt: float

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


def signal_of(model: Model, trials: Sequence[Trial], i: int) -> Signal:
    """Return state i of some trials."""
    unit, columns = list(model.states.values())[i], [trial.states[:, i] for trial in trials]
    name, angle = model.state_names[i], bool(model.angle_mask[i])
    return Signal(name, unit, angle, columns, trials[0].dt)


def judge_signal(signal: Signal) -> tuple[list[Finding], Signal]:
    """Return the findings of a signal, and the corrected signal."""
    findings = list[Finding]()
    for look in (_wrapped, _dropouts, _held, _stuck):
        if seen := look(signal):
            findings.append(seen[0])
            signal = seen[1]
    return findings, signal


def runs(x: Array) -> tuple[Any, Any]:
    """Return starts and lengths of the runs of equal samples in x (T,); NaN equals nothing."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]]))
    return edges[:-1], np.diff(edges)


def _share(gone: Sequence[Any]) -> float:
    return float(np.concatenate(list(gone)).mean())


def _wrapped(s: Signal) -> Found | None:
    """Find jumps by a full turn, in radians or degrees, in an angle whose differences don't wrap.

    Each log may have a unit of its own; which one it is, the accounts of units tell.
    """
    for turn in FULL_TURNS if s.unit == "rad" and not s.angle else ():
        jumps = [_jumps(x, turn) for x in s.columns]
        if count := int(sum(np.abs(k).sum() for k in jumps)):
            ways = [turn * np.concatenate([[0.0], np.cumsum(k)]) for k in jumps]
            whole = [x - way for x, way in zip(s.columns, ways, strict=True)]
            one = s.told("wrapped", mended=True, count=count)
            return replace(one, keys={"unwrap": True}), replace(s, columns=whole)
    return None


def _jumps(x: Array, turn: float) -> Array:
    """Return by how many turns the samples of a log (T + 1,) jump, (T,); 0 where it moves far."""
    steps = np.diff(x)
    size = np.abs(steps)
    calm = np.quantile(size[size > 0], NEARLY_ALL) < 0.2 * turn if (size > 0).any() else False
    return np.asarray(calm * np.nan_to_num(np.sign(steps) * (np.abs(size - turn) < 0.1 * turn)))


def _dropouts(s: Signal) -> Found | None:
    """Find a fixed value that the signal jumps to for single samples."""
    if s.changes.size < FEWEST_SAMPLES:
        return None
    far, values = 10 * float(np.quantile(s.changes, NEARLY_ALL)), []
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
    if len(lengths) < FEWEST_SAMPLES or not s.changes.size:
        return None
    coarse = np.quantile(s.changes, 0.5) < 2.5 * s.changes.min()  # coarse quantisation
    if coarse or np.mean(np.array(lengths) >= 2) < NEARLY_ALL:
        return None
    one = s.told("held", _share(gone), mended=True, every=float(np.median(lengths)) * s.dt)
    return replace(one, mend=one.said), s.without(gone)


def _stuck(s: Signal) -> Found | None:
    """Find a value that stays exactly constant and then jumps to the true one."""
    if s.changes.size < FEWEST_SAMPLES:
        return None
    far, gone, longest = 2 * float(np.median(s.changes)), [], 0
    for x in s.columns:
        flat = np.zeros(len(x), bool)
        for start, length in zip(*runs(x), strict=True):
            end = start + length
            if length < STEPS_TO_JUDGE or not start or end >= len(x):
                continue
            onward = abs(x[end + 1] - x[end]) if end + 1 < len(x) else np.inf
            if abs(x[end] - x[start]) > max(far, 3 * onward):
                flat[start + 1 : end] = True
                longest = max(longest, int(length))
        gone.append(flat)
    if not longest:
        return None
    return s.told("stuck", _share(gone), mended=True, stuck=longest * s.dt), s.without(gone)


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
