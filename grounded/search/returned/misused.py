"""Find how a program misused its candidate: states in other units or places, a time not in seconds.

The log is right then, and the run is not the candidate's all the same. The policy is evaluated as
the program would have done it: on the logged states in degrees, millimetres or in another order, or
at the steps that a time in milliseconds gives. What reproduces the logged commands is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from grounded.model import Model
from grounded.policy import Policy
from grounded.result import listed, with_unit
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import multiplied
from grounded.search.returned.other_scale import NEARLY, UNITS, units_tried
from grounded.search.returned.who_drove import DECISIVE, FINE, Following, evidence, follows, latest
from grounded.task import Task
from grounded.trial import Trial

SAME = 2.0  # ratio of the differences left by two misuses that explain a log equally well
LEAVES = 0.25  # largest share of the original difference that a misuse may leave
TIMES = {"ms": 1e3, "us": 1e6, "minutes": 1 / 60}  # units of a time that should be in seconds


def misused(task: Task, own: Candidate, trial: Trial, plain: Following) -> str:
    """Return what the program passed to its candidate that reproduces the commands, and the remedy.

    Args:
        task: the task of the candidate.
        own: the candidate.
        trial: the run, not longer than the horizon.
        plain: the comparison of its commands with those on the logged states and times.

    Returns:
        The end of a sentence about its commands; "" if nothing reproduces them.
    """
    late, most, found = latest(task), min(LEAVES * plain.error, NEARLY), []
    for policy, passed, said in _ways(task.model, own, trial):
        fit = follows(policy, passed, late)
        if fit is not None and fit.alike and fit.error < most and evidence(plain, fit) > DECISIVE:
            changed = int((passed.states != trial.states).any(axis=0).sum())
            found.append((fit.error, -changed, said))
    least = min((error for error, _, _ in found), default=0.0)
    # at the limits one state may explain as much as all, but a program passes all in one unit
    near = [one for one in found if one[0] <= SAME * least + FINE]
    return min(near, key=lambda one: (one[1], one[0]))[2] if near else ""


def _ways(model: Model, own: Candidate, trial: Trial) -> Iterator[tuple[Policy, Trial, str]]:
    """Yield policies and trials as a program may have combined them, with what that means."""
    policy, name = own.policy, own.id
    held = np.allclose(trial.inputs[0], policy.past, rtol=0, atol=1e-9)  # its first was not sent
    for unit, factor in TIMES.items():
        if factor < 1 or not held:
            yield (
                _at_times(policy, factor),
                trial,
                f"they are what {name} sends if the time is passed to `runner.action` in {unit}: "
                "pass t in seconds since the start of the run",
            )
    if held:
        yield (
            _at_times(policy, np.inf),
            trial,
            f"all are the {_held(model, policy)} that {name} sends once its time is past the end: "
            "pass `runner.action` the seconds since the start of the run, not those of a clock",
        )
    yield (
        _at_times(policy, 0.0),
        trial,
        f"they are what {name} sends if the time stays at 0: pass `runner.action` the seconds "
        "since the start of the run",
    )
    if policy.gain is None:
        return
    for names, factor in units_tried(model):
        if set(names) <= set(model.state_names):
            units = " and ".join(dict.fromkeys(model.states[one] for one in names))
            yield (
                policy,
                multiplied(trial, names, factor),
                f"they are what {name} sends if {listed(list(names))} "
                f"{'is' if len(names) == 1 else 'are'} passed to `runner.action` "
                f"{_unit(model, names, factor)}: pass {units}",
            )
    for i, j in combinations(range(model.n), 2):
        order = np.arange(model.n)
        order[[i, j]] = j, i
        one, other = model.state_names[i], model.state_names[j]
        yield (
            policy,
            replace(trial, states=trial.states[:, order]),
            f"they are what {name} sends if {one} and {other} are passed to `runner.action` in "
            f"each other's place: the order is {', '.join(model.state_names)}",
        )


def _unit(model: Model, names: Sequence[str], factor: float) -> str:
    """Return `in degrees`, or by which number they were multiplied."""
    if factor == -1.0:
        return "with the opposite sign"
    named = {(units, 1 / by): unit for units, by, unit in UNITS}
    own = {model.states[one] for one in names}
    for (units, by), unit in named.items():
        if np.isclose(by, factor, rtol=1e-6) and own <= set(units):
            return f"in {unit}"
    return f"times {factor:.4g}"


def _held(model: Model, policy: Policy) -> str:
    pairs = zip(model.inputs.items(), policy.past + 0.0, strict=True)
    return listed([with_unit(f"{name} = {value:.3g}", unit) for (name, unit), value in pairs])


def _at_times(policy: Policy, factor: float) -> Policy:
    """Return the policy as it acts if the times passed to its runner are multiplied by a factor."""
    H = policy.horizon
    with np.errstate(all="ignore"):
        times = np.arange(H) * factor
        times[np.isnan(times)] = np.inf  # 0 times inf: a clock is past the end at once
    over = times > H - 1
    step = np.minimum(np.floor(np.where(over, 0.0, times) + 0.5), H - 1).astype(int)
    sent = np.where(over[:, None], policy.past, policy.feedforward[step])
    if policy.gain is None or policy.reference is None:
        return replace(policy, feedforward=sent)
    gain = np.where(over[:, None, None], 0.0, policy.gain[step])
    if not factor:  # the runner keeps the last command of each step: none but those held before
        n = len(policy.state_names)
        off = np.repeat(policy.past, policy.depths) - policy.reference[0, n:]
        sent, gain[:, :, n:] = sent + gain[0, :, n:] @ off, 0.0
    return replace(policy, feedforward=sent, gain=gain, reference=policy.reference[step])
