"""Tell when the integrator's step is too long for the model, or for a motion in one trial.

A fast motor, a stiff spring or dry friction over a narrow range of speed can be too fast for one
step a control step: at a time constant of half a step, RK4 misses a fifth of the change. A fit
then makes up for it with wrong parameters, and a diagnosis with effects that no robot has. So the
model's step is compared with 2, 4, 8 ... parts of it, at the states and inputs of the trials.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from grounded.accounts.finding import Finding
from grounded.accounts.levels import EXPLAINED, NEARLY_ALL, SLIGHT, SMALL
from grounded.findings import Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

ROWS = 5_000  # samples that are compared
PARTS = (2, 4, 8, 16, 32, 64)


def judge_time_step(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Finding]:
    """Return the finding on the state that the model's steps miss most, if they are too long.

    Only a model given by its derivative is integrated here; states without a sensor are 0.
    """
    own, dt = np.isin(np.arange(model.n), shown), trials[0].dt
    x = np.concatenate([np.where(own, trial.states[:-1], 0.0) for trial in trials])
    u = np.concatenate([trial.inputs for trial in trials])
    known = np.flatnonzero(np.isfinite(x).all(axis=1) & np.isfinite(u).all(axis=1))
    known = known[:: 1 + len(known) // ROWS]
    if model.derivative is None or not len(known):
        return []
    x, u = x[known], u[known]
    # finer and finer, until it makes no difference
    runs, enough = [_after_a_step(model, x, u, dt, 1)], False
    for parts in PARTS:
        runs.append(_after_a_step(model, x, u, dt, parts))
        if enough := bool(_missed(model, x, runs[-2], runs[-1]).max() <= SLIGHT):
            break
    missed = _missed(model, x, runs[0], runs[-1])
    worst = int(np.argmax(missed))
    if not missed[worst] > SMALL or not own[worst]:
        return []
    said = found(
        "plan.time_step",
        model.state_names[worst],
        share=float(missed[worst]),
        step=Quantity(1e3 * dt / model.substeps, "ms"),
        substeps=model.substeps * 2 ** (len(runs) - 2) if enough else 0,
        file="model.py",
    )
    return [Finding(model.state_names[worst], said, "time step", mend=said)]


def _after_a_step(model: Model, x: Array, u: Array, dt: float, parts: int) -> Array:
    """Return the states (N, n) after a control step that is made in so many parts."""
    with np.errstate(all="ignore"):
        for _ in range(parts):
            x = model.system.step(x, u, model.values, dt / parts)
    return np.asarray(x)


def _missed(model: Model, x: Array, once: Array, finer: Array) -> Array:
    """Return the difference of two results, relative to the change in the step, rms, (n,).

    The largest differences are left out: a few samples of a fall say nothing about the others.
    """
    with np.errstate(all="ignore"):
        off, change = model.difference(once, finer) ** 2, model.difference(finer, x) ** 2
        known = np.isfinite(off).any(axis=0)  # else it overflowed everywhere
        off[:, ~known] = change[:, ~known] = 0.0
        usual = ~(off > np.nanquantile(off, NEARLY_ALL, axis=0))
        off, change = (np.nanmean(np.where(usual, y, np.nan), axis=0) ** 0.5 for y in (off, change))
        least = 1e-6 * np.nanmax(np.abs(x), axis=0) + 1e-12  # of a state that stands still
        return np.nan_to_num(np.where(change > least, off / change, 0.0), posinf=0.0)


def judge_resolution(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> Iterator[tuple[int, int, Finding]]:
    """Yield (trial, number of steps to keep, finding) of each trial that is to be cut.

    A policy that fails can whirl an arm up to speeds at which the integrator misses by more than
    the body moves in sound trials, and one such trial outweighs all others.
    """
    if model.derivative is None or len(trials) < 2:
        return
    own = np.isin(np.arange(model.n), shown)
    states = [np.nan_to_num(np.where(own, trial.states, 0.0)) for trial in trials]
    usual = np.median([x.std(axis=0) for x in states], axis=0)
    cut = dict[int, tuple[int, int]]()
    for k, (trial, x) in enumerate(zip(trials, states, strict=True)):
        once, twice = (_after_a_step(model, x[:-1], trial.inputs, trial.dt, n) for n in (1, 2))
        off = np.abs(model.difference(once, twice)) / np.where((usual > 0) & own, usual, np.inf)
        off = np.nan_to_num(off)
        if (far := (off > EXPLAINED).any(axis=1)).any():
            keep = int(far.argmax())
            cut[k] = keep, int(off[keep].argmax())
    for k, (keep, worst) in cut.items() if 2 * len(cut) < len(trials) else ():
        (name, unit), trial = list(model.states.items())[worst], trials[k]
        said = found(
            "sensor.unresolved",
            name,
            reach=Quantity(float(np.abs(states[k][:, worst]).max()), unit),
            trial=trial.id or f"trial {k + 1}",
            at=Quantity(keep * trial.dt, "s"),
            step=Quantity(1000 * trial.dt, "ms"),
        )
        share = 1 - keep / len(trial.inputs)
        yield k, keep, Finding(name, said, "unresolved", share=share, corrected=True)
