"""What it costs that the robot's program handed over states that were not new.

A policy takes what it is given for where the robot is now. At 1.8 m/s a pose that is 6.8 ms old is
12 mm behind, so the robot runs 12 mm ahead of its target, in every run. The first plan doesn't know
that; later ones allow for the age that the commands show (`grounded.search.feedback.sample_age`).
"""

from __future__ import annotations

import numpy as np

from grounded.frozen import Array
from grounded.result import listed, measured_alike
from grounded.search.candidate import Candidate
from grounded.search.feedback.sample_age import sample_age
from grounded.trial import Trial
from grounded_trials.workspace.folder import Folder

LEADS = 0.3  # share of a state's error over the run: a smaller motion since the sample is not told


def old_samples(workspace: Folder, own: Candidate, trial: Trial, old: Array) -> list[str]:
    """Return a note if the states that the program acted on had moved on by much of their errors.

    Args:
        workspace: whose task the run follows.
        own: the candidate that was run, whose commands the log reproduces.
        trial: its run.
        old: mean age of each state's samples when commands were sent [s], (n,).
    """
    task, effects = workspace.task, workspace.config.model.effects
    delayed = [str(e["name"]) for e in effects if str(e["name"]).startswith("sensor_delay:")]
    allowed = {n for name in delayed for n in name.partition(":")[2].split("+")}
    states = trial.states[: task.horizon + 1]
    if own.policy.gain is None or own.sample_age or len(states) < 2:
        return []
    error = task.model.difference(states, task.target[: len(states)])
    rates = task.model.difference(states[1:], states[:-1]) / task.dt
    off, speed = (_rms(e) for e in (error, rates))
    fed = np.abs(own.policy.gain[..., : states.shape[1]]).max(axis=(0, 1)) > 0  # not past inputs
    counts = fed & (task.reward.state > 0) & (old > 0) & (old * speed > LEADS * off)
    told = [i for i in np.flatnonzero(counts) if task.model.state_names[i] not in allowed]
    if not told:
        return []
    names, units = task.model.state_names, list(task.model.states.values())
    cost = []
    for i in told:
        moved, missed = measured_alike([old[i] * speed[i], off[i]], units[i])
        cost.append(f"{names[i]} by {moved} (its error in this run: {missed} rms)")
    ages = sorted({float(f"{1e3 * old[i]:.2g}") for i in told})
    span = " to ".join(f"{age:g}" for age in dict.fromkeys((ages[0], ages[-1])))
    fresh = "newer samples, or each moved on by its rate times its age"
    then = f"{own.id} does not allow for that: pass `runner.action` {fresh}"
    if sample_age(task, own, [trial]):
        then = f"{own.id} does not allow for that, the next candidates do; better still are {fresh}"
    return [
        f"by the stamps, its program acted on samples that were {span} ms old on average; by then "
        f"{listed(cost)} had moved on. {then}"
    ]


def _rms(error: Array) -> Array:
    """Return the rms along the first axis, NaN for a state without a target or a measurement."""
    known = np.isfinite(error)
    total = np.where(known, error, 0.0) ** 2
    return np.asarray(
        np.sqrt(total.sum(axis=0) / np.where(known.any(axis=0), known.sum(axis=0), np.nan))
    )
