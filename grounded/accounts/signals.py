"""The samples of one sensor on its own: they repeat, drop out, stick or jump by a turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.accounts.finding import Finding
from grounded.accounts.levels import FACTOR, FEWEST_SAMPLES, NEARLY_ALL, STEPS_TO_JUDGE
from grounded.findings import found
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

FULL_TURNS = (2 * np.pi, 360.0)

Columns = Sequence[Array]  # the samples of a state in each trial, (T + 1,), NaN where missing
Gone = tuple[Sequence[Any], Mapping[str, Any]]  # samples that show nothing, and what is told of it


def judge_samples(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> tuple[list[Finding], list[Trial]]:
    """Check the samples of each sensor on its own; return the findings and the mended trials."""
    findings, mended = list[Finding](), [np.array(trial.states) for trial in trials]
    for i in shown:
        name, unit = list(model.states.items())[i]
        columns: Columns = [x[:, i] for x in mended]
        if unit == "rad" and not model.angle_mask[i]:
            columns, count = _unwrapped(columns)
            said = found("sensor.samples", name, count=count)
            one = Finding(name, said, "wrapped", corrected=True, keys={"unwrap": True})
            findings += [one] * (count > 0)
        for kind, look in (("dropout", _dropouts), ("held", _held), ("stuck", _stuck)):
            sizes = np.concatenate([np.abs(np.diff(x)) for x in columns])
            sizes = sizes[np.isfinite(sizes) & (sizes > 0)]  # of all changes
            seen = look(columns, sizes, trials[0].dt) if len(sizes) >= FEWEST_SAMPLES else None
            if seen:
                gone, facts = seen
                share, said = _share(gone), found("sensor.samples", name, **facts)
                findings.append(Finding(name, said, kind, share=share, corrected=True))
                columns = [np.where(g, np.nan, x) for g, x in zip(gone, columns, strict=True)]
        for x, column in zip(mended, columns, strict=True):
            x[:, i] = column
    return findings, [replace(t, states=x) for t, x in zip(trials, mended, strict=True)]


def _share(gone: Sequence[Any]) -> float:
    return float(np.concatenate(list(gone)).mean())


def _unwrapped(columns: Columns) -> tuple[Columns, int]:
    """Return an angle without its jumps by a full turn, in radians or degrees; and their number.

    Each log may have a unit of its own; which one it is, the accounts of units tell.
    """
    for turn in FULL_TURNS:
        jumps = [_jumps(x, turn) for x in columns]
        if count := int(sum(np.abs(k).sum() for k in jumps)):
            ways = [turn * np.concatenate([[0.0], np.cumsum(k)]) for k in jumps]
            return [x - way for x, way in zip(columns, ways, strict=True)], count
    return columns, 0


def _jumps(x: Array, turn: float) -> Array:
    """Return by how many turns the samples of a log (T + 1,) jump, (T,); 0 where it moves far."""
    steps = np.diff(x)
    size = np.abs(steps)
    calm = np.quantile(size[size > 0], NEARLY_ALL) < 0.2 * turn if (size > 0).any() else False
    return np.asarray(calm * np.nan_to_num(np.sign(steps) * (np.abs(size - turn) < 0.1 * turn)))


def _dropouts(columns: Columns, sizes: Array, dt: float) -> Gone | None:
    """Find a fixed value that a signal jumps to for single samples."""
    far, values = 10 * float(np.quantile(sizes, NEARLY_ALL)), []
    for x in columns:
        there = (np.abs(x[1:-1] - x[:-2]) > far) & (np.abs(x[1:-1] - x[2:]) > far)
        values += list(x[1:-1][there & (np.abs(x[2:] - x[:-2]) < far)])
    known, counts = np.unique(values, return_counts=True)
    if not len(known) or counts.max() < 3:
        return None
    value = float(known[np.argmax(counts)])
    gone = [
        (x == value) & ((np.abs(x - np.roll(x, 1)) > far) | (np.abs(x - np.roll(x, -1)) > far))
        for x in columns
    ]
    return gone, {"low": f"{value:g}", "share": _share(gone)}


def _held(columns: Columns, sizes: Array, dt: float) -> Gone | None:
    """Find a signal that repeats every value: the sensor or its topic is slower than the log."""
    lengths, gone = list[int](), list[Any]()
    for x in columns:
        start, length = _runs(x)
        lengths += list(length[np.isfinite(np.diff(x[start], append=np.nan))])
        gone.append(np.isfinite(x) & ~np.isin(np.arange(len(x)), start))
    coarse = np.quantile(sizes, 0.5) < 2.5 * sizes.min()  # coarse quantisation
    if coarse or np.mean(np.array(lengths) >= 2) < NEARLY_ALL:
        return None
    return gone, {"every": float(np.median(lengths)) * dt}


def _stuck(columns: Columns, sizes: Array, dt: float) -> Gone | None:
    """Find a value that stays exactly constant and then jumps to the true one."""
    far, gone, longest = 2 * float(np.median(sizes)), [], 0
    for x in columns:
        flat = np.zeros(len(x), bool)
        for start, length in zip(*_runs(x), strict=True):
            end = start + length
            if length < STEPS_TO_JUDGE or not start or end >= len(x):
                continue
            onward = abs(x[end + 1] - x[end]) if end + 1 < len(x) else np.inf
            if abs(x[end] - x[start]) > max(far, FACTOR * onward):
                flat[start + 1 : end] = True
                longest = max(longest, int(length))
        gone.append(flat)
    return (gone, {"stuck": longest * dt}) if longest else None


def _runs(x: Array) -> tuple[Any, Any]:
    """Return starts and lengths of the runs of equal samples in x (T,); NaN equals nothing."""
    edges = np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]]))
    return edges[:-1], np.diff(edges)


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
