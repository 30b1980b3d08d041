"""What a person should know about a trial before believing it, in sentences."""

from __future__ import annotations

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy, z_difference
from grounded.task import Task
from grounded.trial import HUGE, Trial, bridge
from grounded_trials.workspace.folder import Folder

FAR = 0.1  # of a state's range in the trial: a start this far from s_0 is worth a warning


def warnings_about(workspace: Folder, trial: Trial) -> tuple[str, ...]:
    """Gaps, an early end, a start far from s_0, inputs outside the limits or logged late."""
    task = workspace.task
    filled = bridge(trial)
    found = []
    if filled.samples:
        found.append(
            f"{filled.samples} lost samples were interpolated, the longest gap is "
            f"{filled.longest_s:.2f} s of '{filled.state}' at {filled.at_s:.2f} s"
        )
    whole = filled.trial
    if whole.finite_steps < whole.steps:
        name, step = _first_bad(whole)
        found.append(
            f"'{name}' is not a finite number at {step * trial.dt:.2f} s: the trial counts as "
            "ended there"
        )
    if not trial.candidate:
        return tuple(found)
    if whole.steps < task.horizon:
        found.append(
            f"the run ended after {whole.steps} of {task.horizon} steps "
            f"({whole.steps * trial.dt:.2f} s): a failed candidate; its data stay usable for "
            "fit and diagnose"
        )
    if whole.steps > task.horizon:
        found.append(
            f"the log goes on for {whole.steps - task.horizon} steps after the horizon of "
            f"{task.horizon}: they are not judged"
        )
    whole = whole.until(task.horizon)
    found += _start(task, whole)
    found += _inputs(task, whole)
    candidate, _ = workspace.candidate(trial.candidate)
    found += _late(candidate.policy, task, whole)
    return tuple(found)


def _first_bad(trial: Trial) -> tuple[str, int]:
    """The first state or input that is not a finite number, and its step."""
    places = [
        (int(step), name)
        for values, names in ((trial.states, trial.state_names), (trial.inputs, trial.input_names))
        for column, name in zip(values.T, names, strict=True)
        for step in np.flatnonzero(~(np.abs(column) < HUGE))[:1]
    ]
    step, name = min(places, key=lambda place: place[0])
    return name, step


def _start(task: Task, trial: Trial) -> list[str]:
    if trial.finite_steps < 0:
        return []
    off = task.model.difference(trial.states[0], task.start)
    usual = np.ptp(trial.states[: trial.finite_steps + 1], axis=0)
    found = []
    for i, name in enumerate(trial.state_names):
        if np.isfinite(off[i]) and abs(off[i]) > max(FAR * usual[i], 1e-9):
            found.append(
                f"the run started with {name} = {trial.states[0, i]:.3g}, the task's start is "
                f"{task.start[i]:.3g}: the search assumes one start state"
            )
    return found


def _inputs(task: Task, trial: Trial) -> list[str]:
    if not trial.steps:
        return []
    excess = np.maximum(task.low - trial.inputs, trial.inputs - task.high).max(axis=0)
    return [
        f"the log has {name} up to {excess[i]:.3g} outside its [limits]: log the COMMANDS, after "
        "clipping"
        for i, name in enumerate(trial.input_names)
        if excess[i] > 1e-6
    ]


def _late(policy: Policy, task: Task, trial: Trial) -> list[str]:
    """Inputs that fit the policy better when they are moved by a step were logged late."""
    T = min(trial.finite_steps, policy.horizon)
    if T < 10 or (trial.state_names, trial.input_names) != (policy.state_names, policy.input_names):
        return []
    expected = _commands(policy, task, trial, T)
    if expected.shape[0] < 10:
        return []
    scale = np.ptp(expected, axis=0) + 1e-12
    errors = {}
    for shift in (-1, 0, 1):
        a = expected[max(0, -shift) : T - max(0, shift)]
        b = trial.inputs[:T][max(0, shift) : T - max(0, -shift)]
        errors[shift] = float(np.sqrt(np.mean(((a - b) / scale) ** 2)))
    best = min(errors, key=errors.__getitem__)
    if best == 0 or errors[0] < 0.01 or errors[best] > 0.5 * errors[0]:
        return []
    word = "late" if best == 1 else "early"
    return [
        f"the inputs fit the policy better when moved by one step: they seem to be logged a step "
        f"{word}; log each command at the time it is sent"
    ]


def _commands(policy: Policy, task: Task, trial: Trial, T: int) -> Array:
    """What the policy commands on the trial's own states, (T, m)."""
    u = np.array(policy.feedforward[:T])
    if policy.gain is not None and policy.reference is not None:
        from grounded.rollout import augmented

        past = policy.past if trial.start_inputs is None else trial.start_inputs
        z = augmented(task.problem(exact=True), trial.states[: T + 1], trial.inputs[:T], past)[:T]
        if z.shape[1] != policy.reference.shape[1]:
            return u[:0]
        off = z_difference(z, policy.reference[:T], policy.angles)
        u += np.einsum("tij,tj->ti", policy.gain[:T], off)
    return np.clip(u, policy.low, policy.high)
