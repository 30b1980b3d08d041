"""Cut trials where the body moves too fast for the model to be integrated with its time step.

A policy that fails can whirl an arm up to speeds far beyond those of the manoeuvre. There the
integrator misses by more than the body moves in sound trials, whatever effect is added to the
model, and one such trial outweighs all others. What came before is kept.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import Finding
from grounded.instruments.predictions.time_step import after_a_step
from grounded.model import Model
from grounded.trial import Trial

MISSES = 0.1  # of a state's spread in other trials: error of one step against two half steps
BEYOND = 5.0  # times as large as any sample of most other trials


def judge_resolution(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> Iterator[tuple[int, int, Finding]]:
    """Yield (trial, number of steps to keep, finding) of each trial that is to be cut.

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
        missed = _error_of_a_step(model, trial, shown)
        known = np.isfinite(missed).all(axis=1)
        beyond = np.abs(trial.states[:-1]) > BEYOND * far
        bad = known & (missed > MISSES * usual).any(axis=1) & beyond[:, shown].any(axis=1)
        if not bad.any():
            continue
        keep = int(np.argmax(bad))
        worst = max(shown, key=lambda i: missed[keep, i] / max(usual[i], 1e-300))
        name = model.state_names[worst]
        unit = model.states[name]
        where = f"trial {trial.id or f'number {k + 1}'}"
        text = (
            f"reaches {reach[k, worst]:.3g} {unit} in {where}, {far[worst]:.3g} {unit} in most "
            f"others: from {keep * trial.dt:.3g} s on, the model can't be integrated with time "
            f"steps of {1000 * trial.dt:.3g} ms, and the rest of that trial is left out"
        )
        share = 1 - keep / len(trial.inputs)
        yield k, keep, Finding(name, text, "unresolved", share=share, corrected=True)


def _extent(trial: Trial) -> tuple[Array, Array]:
    """Return spread and largest size of each state (n,), infinite if it was not measured."""
    spread, reach = np.full((2, trial.states.shape[1]), np.inf)
    seen = np.flatnonzero(np.isfinite(trial.states).any(axis=0))
    spread[seen] = np.nanstd(trial.states[:, seen], axis=0)
    reach[seen] = np.nanmax(np.abs(trial.states[:, seen]), axis=0)
    return spread, reach


def _error_of_a_step(model: Model, trial: Trial, shown: Sequence[int]) -> Array:
    """Return the difference of one step from two half steps at each sample, (T, n)."""
    x = np.array(trial.states[:-1])
    x[:, [i for i in range(model.n) if i not in shown]] = 0.0  # unknown
    once, twice = (after_a_step(model, x, trial.inputs, trial.dt, parts) for parts in (1, 2))
    return np.asarray(np.abs(model.difference(once, twice)))
