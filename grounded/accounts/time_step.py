"""Tell when the integrator's step is too long for the model.

A fast motor, a stiff spring or dry friction over a narrow range of speed can be too fast for one
step a control step: at a time constant of half a step, RK4 misses a fifth of the change. A fit
then makes up for it with wrong parameters, and a diagnosis with effects that no robot has. So the
model's step is compared with 2, 4, 8 ... parts of it, at the states and inputs of the trials.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from grounded import findings as told
from grounded.accounts.finding import Finding
from grounded.findings import Quantity
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

MISSED = 0.05  # part of a state's change in a step, rms, from which a step is too long
FINE = 0.01  # the same for a step that is short enough
MOVES = 1e-6  # of a state's range: smaller changes in a step are not judged
USUAL = 0.95  # share of the samples that is compared, those with the smallest differences
ROWS = 5_000  # samples that are compared
MISSES = 0.1  # of a spread in other trials: error of one step against two half steps
BEYOND = 5.0  # times as large as any sample of most other trials
PARTS = (2, 4, 8, 16, 32, 64)


def judge_time_step(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> list[Finding]:
    """Return the finding on the state that the model's steps miss most, if they are too long.

    Args:
        model: only one given by its derivative is integrated here.
        trials: in the model's units.
        shown: indices of the states with a sensor; the others are taken as 0.
    """
    x = np.concatenate([t.states[:-1] for t in trials])
    u, hidden = np.concatenate([t.inputs for t in trials]), np.ones(model.n, bool)
    hidden[list(shown)] = False
    found = too_long(model, np.where(hidden, 0.0, x), u, trials[0].dt)
    if found is None or hidden[model.state_names.index(found.about[0])]:
        return []
    return [Finding(found.about[0], found, "time step", mend=found)]


def too_long(
    model: Model, states: Array, inputs: Array, dt: float, file: str = "model.py"
) -> told.Finding | None:
    """Compare the model's step with finer ones.

    Args:
        model: the model; one without `derivative` takes its own steps and is not judged.
        states: (N, n); rows that are not finite are left out.
        inputs: (N, m), held over the step.
        dt: control step [s].
        file: of the model.

    Returns:
        By how much a step misses the worst state, and how many steps are enough; None if they are
        short enough.
    """
    if model.derivative is None:
        return None
    known = np.flatnonzero(np.isfinite(states).all(axis=1) & np.isfinite(inputs).all(axis=1))
    known = known[:: 1 + len(known) // ROWS]
    if not len(known):
        return None
    x, u = states[known], inputs[known]
    runs, enough = [after_a_step(model, x, u, dt, 1)], False
    for parts in PARTS:
        runs.append(after_a_step(model, x, u, dt, parts))
        enough = bool(_missed(model, x, runs[-2], runs[-1]).max() <= FINE)
        if enough:
            break
    missed = _missed(model, x, runs[0], runs[-1])
    worst = int(np.argmax(missed))
    if not missed[worst] > MISSED:
        return None
    own = model.substeps
    return told.found(
        "plan.time_step",
        model.state_names[worst],
        share=float(missed[worst]),
        step=Quantity(1e3 * dt / own, "ms"),
        substeps=own * 2 ** (len(runs) - 2) if enough else 0,
        file=file,
    )


def after_a_step(model: Model, x: Array, u: Array, dt: float, parts: int) -> Array:
    """Return the states (N, n) after a control step that is made in so many parts."""
    with np.errstate(all="ignore"):
        for _ in range(parts):
            x = model.system.step(x, u, model.values, dt / parts)
    return np.asarray(x)


def _missed(model: Model, x: Array, one: Array, finer: Array) -> Array:
    """Return the difference of two results, relative to the change in the step, rms, (n,).

    The largest differences are left out: a few samples of a fall say nothing about the others.
    """
    with np.errstate(all="ignore"):
        off, change = model.difference(one, finer) ** 2, model.difference(finer, x) ** 2
        known = np.isfinite(off).any(axis=0)  # else it overflowed everywhere
        off[:, ~known] = change[:, ~known] = 0.0
        usual = ~(off > np.nanquantile(off, USUAL, axis=0))
        off, change = (np.nanmean(np.where(usual, y, np.nan), axis=0) ** 0.5 for y in (off, change))
        least = MOVES * np.nanmax(np.abs(x), axis=0) + 1e-12
        return np.nan_to_num(np.where(change > least, off / change, 0.0), posinf=0.0)


def judge_resolution(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> Iterator[tuple[int, int, Finding]]:
    """Yield (trial, number of steps to keep, finding) of each trial that is to be cut.

    A policy that fails can whirl an arm up to speeds far beyond those of the manoeuvre. There the
    integrator misses by more than the body moves in sound trials, whatever effect is added to the
    model, and one such trial outweighs all others. What came before is kept.

    Args:
        model: however crude; only one given by its derivative is integrated here.
        trials: in the model's units.
        shown: indices of the states with a sensor; the others are taken as 0.
    """
    if model.derivative is None or len(trials) < 2:
        return
    size, reach = np.array([_extent(t) for t in trials]).swapaxes(0, 1)
    for k, trial in enumerate(trials):
        others = [j for j in range(len(trials)) if j != k]
        usual, far = np.median(size[others], axis=0), np.median(reach[others], axis=0)
        # the difference of one step from two half steps at each sample
        x = np.array(trial.states[:-1])
        x[:, [i for i in range(model.n) if i not in shown]] = 0.0
        once, twice = (after_a_step(model, x, trial.inputs, trial.dt, parts) for parts in (1, 2))
        missed = np.abs(model.difference(once, twice))
        known = np.isfinite(missed).all(axis=1)
        beyond = np.abs(trial.states[:-1]) > BEYOND * far
        bad = known & (missed > MISSES * usual).any(axis=1) & beyond[:, shown].any(axis=1)
        if not bad.any():
            continue
        keep = int(np.argmax(bad))
        worst = max(shown, key=lambda i: missed[keep, i] / max(usual[i], 1e-300))
        name = model.state_names[worst]
        unit = model.states[name]
        said = told.found(
            "sensor.unresolved",
            name,
            reach=Quantity(float(reach[k, worst]), unit),
            trial=trial.id or f"trial {k + 1}",
            far=Quantity(float(far[worst]), unit),
            at=Quantity(keep * trial.dt, "s"),
            step=Quantity(1000 * trial.dt, "ms"),
        )
        share = 1 - keep / len(trial.inputs)
        yield k, keep, Finding(name, said, "unresolved", share=share, corrected=True)


def _extent(trial: Trial) -> tuple[Array, Array]:
    """Return spread and largest size of each state (n,), infinite if it was not measured."""
    spread, reach = np.full((2, trial.states.shape[1]), np.inf)
    seen = np.flatnonzero(np.isfinite(trial.states).any(axis=0))
    spread[seen] = np.nanstd(trial.states[:, seen], axis=0)
    reach[seen] = np.nanmax(np.abs(trial.states[:, seen]), axis=0)
    return spread, reach
