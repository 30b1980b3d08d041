"""Find how a program misused its candidate: states in other units or places, a time not in seconds.

The log is right then, and the run is not the candidate's all the same. The policy is evaluated as
the program would have done it: on the logged states in degrees, millimetres or in another order, or
at the steps that a time in milliseconds gives. What reproduces the logged commands is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, TypeVar

import numpy as np

from grounded.accounts.table import unit_named
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.returned.as_predicted import multiplied
from grounded.search.returned.other_scale import CENTI, NEARLY, units_tried
from grounded.search.returned.who_drove import (
    CLEAR,
    DECISIVE,
    FINE,
    Following,
    evidence,
    follows,
    latest,
)
from grounded.task import Task
from grounded.trial import Trial

SAME = 2.0  # ratio of the differences left by two misuses that explain a log equally well
LEAVES = 0.25  # largest share of the original difference that a misuse may leave
TELLS = 0.1  # smallest difference of two commands, relative to their size, that tells them apart
NEARER, NEARLY_ALL = 0.5, 0.95  # a misuse must be so much nearer in that share of these steps
BESIDE = 0.95  # share of a run's commands that are the feed-forward's of that step or a neighbour
DIGITS = 1e-4  # largest difference of commands, relative to their size, that rounding makes
Found = TypeVar("Found", bound=tuple[Any, ...])
TIMES = {"ms": 1e3, "us": 1e6, "minutes": 1 / 60}  # units of a time that should be in seconds


@dataclass(frozen=True, eq=False)
class Way:
    """One way in which a program may misuse a candidate."""

    policy: Policy  # as it acts on what the program passes
    finding: Finding
    names: tuple[str, ...] = ()  # states that are passed multiplied, or in another's place
    factor: float = 1.0
    order: tuple[str, ...] = ()  # all states, as they are passed; () if in the right order

    def passed(self, trial: Trial) -> Trial:
        """Return a trial with its states as the program passed them."""
        if not self.order:
            return multiplied(trial, self.names, self.factor) if self.names else trial
        order = [trial.state_names.index(name) for name in self.order]
        return replace(trial, states=trial.states[:, order])


def misused(
    task: Task, own: Candidate, trial: Trial, plain: Following, *, acts: bool = False
) -> tuple[float, Way] | None:
    """Return what the program passed to its candidate that reproduces the commands, or None.

    Args:
        task: the task of the candidate.
        own: the candidate.
        trial: the run, not longer than the horizon.
        plain: the comparison of its commands with those on the logged states and times.
        acts: whether other commands than those held before a run are sent elsewhere in its log.

    Returns:
        What is left of the commands, relative to their size, and the way that leaves it.
    """
    late, most, some = latest(task), min(LEAVES * plain.error, NEARLY), list[tuple[float, Way]]()
    held = np.abs(trial.inputs - own.policy.past).max(axis=1) <= 1e-9
    over, moved = bool(held.all()) and not acts, np.abs(trial.inputs - own.policy.past).max(axis=0)
    for way in ways(task.model, own, unsent=bool(held[0]), over=over):
        fit = follows(way.policy, way.passed(trial), late)
        if fit is None or not fit.alike or (error := _share(fit, moved)) >= most:
            continue
        if evidence(plain, fit) > DECISIVE and _tells(plain, fit):
            if way.policy.gain is None and own.policy.gain is not None and not _beside(trial, fit):
                way = replace(way, finding=found("run.other_states", ran=own.id))
            some.append((error, way))
    least = min((error for error, _ in some), default=0.0)
    near = [(error, way) for error, way in some if error <= SAME * least + FINE]
    return likeliest(near) if near else None


def without_feedback(own: Candidate, trial: Trial, ran: Following) -> bool:
    """Return whether a run's commands are the feed-forward to the last digits, unlike the policy's.

    Args:
        own: the candidate.
        trial: the run.
        ran: the comparison of its commands with the policy's.
    """
    policy, T = own.policy, min(trial.finite_steps, own.policy.horizon)
    if policy.gain is None:
        return False
    size = ran.fine / FINE
    asked = np.clip(policy.feedforward[:T], policy.low, policy.high)
    alone = np.abs(trial.inputs[:T] - asked) / size
    off = np.abs(ran.off[np.isfinite(ran.off).all(axis=1)]) / size
    apart = float(np.sqrt((off**2).mean())) if len(off) else 0.0
    return bool(alone.max(initial=0.0) < DIGITS and apart > 10 * DIGITS)


def likeliest(some: Sequence[Found]) -> Found:
    """Return the likeliest of (what is left of the commands, the way that leaves it, ...).

    At the limits one state may explain as much as all, but a program passes all in one unit.
    """
    return min(some, key=lambda one: (-len(one[1].names), one[0]))


def _share(fit: Following, moved: Array) -> float:
    """Return what is left of commands, relative to how far the one that moved most did, (m,)."""
    ratio = moved / (fit.fine / FINE)
    return fit.error / float(min(ratio.max(), 1.0)) if moved.any() else fit.error


def _tells(plain: Following, fit: Following) -> bool:
    """Return whether a policy explains nearly all commands in which it differs from the plain one.

    Many policies hold an input at the same limit: such commands are no evidence for one of them.
    """
    size = fit.fine / FINE
    with np.errstate(invalid="ignore"):
        told = np.abs(plain.off - fit.off) > TELLS * size
        nearer = np.abs(fit.off) < NEARER * np.abs(plain.off)
    return bool(told.any() and nearer[told].mean() >= NEARLY_ALL)


def _beside(trial: Trial, fit: Following) -> bool:
    """Return whether a run's commands are those of a policy without feedback, but for their timing.

    Args:
        trial: the run.
        fit: the comparison with that policy. Its commands depend on time alone, which may be off by
            one step.
    """
    asked = trial.inputs[: len(fit.off)] - fit.off
    around = np.stack([np.roll(asked, k, axis=0)[1:-1] for k in (-1, 0, 1)])
    known = np.isfinite(around).all(axis=(0, 2))
    sent, around = trial.inputs[1 : len(fit.off) - 1][known], around[:, known]
    off = sent - np.clip(sent, around.min(axis=0), around.max(axis=0))
    return bool((np.abs(off) <= CLEAR * fit.fine / FINE).all(axis=1).mean() >= BESIDE)


def ways(model: Model, own: Candidate, *, unsent: bool, over: bool = False) -> Iterator[Way]:
    """Yield the ways in which a program may have misused its candidate.

    Args:
        model: the model with the units of the states.
        own: the candidate.
        unsent: whether the first command is the one held before the run, so that none was sent.
        over: whether all are.
    """
    policy, right, ran = own.policy, model.state_names, own.id
    for unit, factor in TIMES.items():
        if factor < 1 or not unsent:
            yield Way(_at_times(policy, factor), found("run.passed", ran=ran, time=unit))
    if over:
        yield Way(_at_times(policy, np.inf), found("run.passed", ran=ran, time="a clock"))
    yield Way(_at_times(policy, 0.0), found("run.passed", ran=ran, time="no unit: it stays 0"))
    if policy.gain is None:
        return
    yield Way(replace(policy, gain=None, reference=None), found("run.unfed", ran=ran))
    tries = [*units_tried(model)]  # of logs: none is in hundreds of metres, but programs use cm
    tries += [(group, 1 / factor) for group, factor in tries if factor == CENTI]
    for group, factor in dict.fromkeys((tuple(group), factor) for group, factor in tries):
        if {*group} <= {*right}:
            unit = unit_named((model.states[one] for one in group), factor)
            how: dict[str, Any] = {"unit": unit} if unit else {"times": factor}
            passed = found("run.passed", ran=ran, states=group, order=right, **how)
            yield Way(policy, passed, group, factor)
    for order in _orders(right):
        moved = tuple(was for was, now in zip(right, order, strict=True) if was != now)
        passed = found("run.passed", ran=ran, passed=order, order=right)
        yield Way(policy, passed, moved, order=order)


def _orders(right: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
    """Yield wrong orders of states that occur: two exchanged, some of the first ones last, sorted.

    A program has positions before velocities where the model has them after, for example.
    """
    known = {right}
    pairs = combinations(range(len(right)), 2)
    orders = [tuple({i: j, j: i}.get(k, k) for k in range(len(right))) for i, j in pairs]
    named = [tuple(right[k] for k in order) for order in orders]
    named += [right[k:] + right[:k] for k in range(1, len(right))]
    for order in (*named, tuple(sorted(right))):
        if order not in known:
            known.add(order)
            yield order


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
