"""Detect feedback that makes inputs oscillate, and keep it at the strength that ran quietly.

A limit cycle shows in a trial: an input swings about its plan, by the plan's range or more
(`swings`), or goes from limit to limit (`between_limits`).

What a loop lacks to be stable (a delay, a filter) is not in the model, so no prediction shows it;
runs do. So the strength of a policy's feedback, input by input,

    mean over t of sum_j |K_tij| d_j,    d_j = rms motion of state j in a step of the run that swung

is compared with that of what ran. After a run that oscillated no later policy of the same model is
stronger than the strongest that ran quietly, or, if none weaker than that run did, than half of it.
A stronger one that runs quietly all the same moves the bound up again. A run that failed, or whose
cost is many times that of the one that swung, shows the opposite, that the robot needs its gains:
then there is no bound, but candidates say what they risk (`risk`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.findings import Finding, found
from grounded.frozen import Array, median
from grounded.policy import Policy
from grounded.search.candidate import Candidate, Tried
from grounded.task import Task
from grounded.trial import Trial

# fraction of an input's range within which it counts as at its limit; share of steps that is often
NEAR_LIMIT, OFTEN_AT_LIMIT = 0.01, 0.3
SWINGS = 6  # swings of an input about its plan by at least the plan's range: a limit cycle
# share of the strength that oscillated, if none weaker than that ran quietly
UNKNOWN_STRENGTH = 0.5
FELL = 10.0  # cost, relative to the run that swung, above which gentler feedback is too weak
HUGE = 1e100  # bound on the motion of a diverged run in a step, in the state's unit
STRONGER = 1.05  # ratio to the bound from which feedback counts as stronger


def limit_cycle(tried: Tried, task: Task, range_: Array | None = None) -> bool:
    """Return whether feedback made an input oscillate in a candidate's trials, see `swings`."""
    range_ = plan_range(tried.candidate, task) if range_ is None else range_
    made = tried.candidate
    return any((swings(made, trial, range_) >= SWINGS).any() for trial in tried.trials)


def swings(made: Candidate, trial: Trial, range_: Array) -> Array:
    """Count the swings of each input about a candidate's plan in one of its runs, (m,) int.

    Each swing is at least as large as a plan's range. It must also exceed the median offset from
    the plan: a sagging load, or friction that holds a joint, needs its gains despite the noise that
    they amplify.

    Args:
        made: the candidate.
        trial: its run.
        range_: range of each input in its plan, or in one that replays no swings (m,); an input
            with range 0 counts as never swinging.
    """
    plan = made.predicted_inputs
    if trial.steps < SWINGS:
        return np.zeros(len(range_), int)
    off = trial.inputs[: len(plan)] - plan[: trial.steps]  # a log may be longer
    sizes = np.maximum(range_, np.abs(median(off)))
    each = zip(off.T, sizes, range_, strict=True)
    return np.array([_swings(one, size) if of > 0 else 0 for one, size, of in each])


def plan_range(made: Candidate, task: Task) -> Array:
    """Return the range of each input in a candidate's plan, at most that of its limits, (m,)."""
    return np.asarray(np.minimum(np.ptp(made.predicted_inputs, axis=0), task.high - task.low))


def between_limits(tried: Tried, task: Task) -> bool:
    """Return whether an input was at its limits, at both of them, for much of a trial."""
    range_ = task.high - task.low
    near = np.where(np.isfinite(range_), NEAR_LIMIT * range_, 0.0)
    for trial in tried.trials:
        at_low, at_high = trial.inputs <= task.low + near, trial.inputs >= task.high - near
        both = at_low.any(axis=0) & at_high.any(axis=0)
        if np.any(both & ((at_low | at_high).mean(axis=0) > OFTEN_AT_LIMIT)):
            return True
    return False


def jumps(inputs: Array, range_: Array) -> Array:
    """Count the steps in which each of the inputs (T, m) changes by over half its range, (m,)."""
    return np.asarray((np.abs(np.diff(inputs, axis=0)) > 0.5 * range_).sum(axis=0))


def _swings(values: Array, size: float) -> int:
    """Count how often a signal reverses and moves by `size` or more."""
    if not (np.abs(values - values[0]) >= size).any():  # as a rule
        return 0
    found, way, last = 0, 0.0, float(values[0])
    for value in values.tolist():  # Python's own numbers: three times as fast
        if (value - last) * way > 0:
            last = value
        elif abs(value - last) >= size:
            found, way, last = found + 1, math.copysign(1.0, value - last), value
    return found


@dataclass(frozen=True, eq=False)
class Quiet:
    """The strength up to which feedback ran quietly, relative to the run that oscillated."""

    task: Task
    swung: Candidate  # the latest whose feedback made an input oscillate
    moved: Array  # (n,) rms motion of each state in a step of its runs
    most: float  # largest strength allowed, as a share of `swung`'s
    by: str  # id of the candidate that ran quietly with it; "" if none did
    needed: bool  # whether weaker feedback failed: `most` is then no bound

    def strength(self, policy: Policy) -> float:
        """Return the strength of a policy's feedback as a share of `swung`'s, of its input most."""
        return _relative(policy, self.swung.policy, self.moved)

    def allows(self, policy: Policy) -> bool:
        """Return whether a policy's feedback is no stronger than what ran quietly."""
        return self.strength(policy) <= STRONGER * self.most

    def risk(self, made: Candidate) -> Finding | None:
        """Return that a candidate's feedback is stronger than what ran quietly; None if not."""
        if self.allows(made.policy):
            return None
        strength, again = self.strength(made.policy), made.id == self.swung.id
        return found(
            "plan.oscillates",
            made.id,
            candidate=made.id,
            swung=self.swung.id,
            strength=None if again else strength,
            quiet=self.by or None,
            share=self.most / strength if self.by else None,
            needed=int(self.needed),
        )


def quiet_gains(task: Task, history: Sequence[Tried], model: str | None = None) -> Quiet | None:
    """Return how strong feedback may be after a run that oscillated; None if none did.

    Args:
        task: the manoeuvre.
        history: all candidates with their trials, in the order of proposal.
        model: fingerprint: only candidates of this model count; None for all.
    """
    ran, loud = list[Tried](), list[Tried]()
    for tried, calm in zip(history, calm_ranges(task, history), strict=True):
        made = tried.candidate
        if tried.trials and made.policy.gain is not None and model in (None, made.model):
            ran.append(tried)
            loud += [tried] * limit_cycle(tried, task, calm)
    if not loud:
        return None
    last = loud[-1]
    moved = _moved(task, last)
    quiet: list[tuple[float, str]] = []
    fallen: list[float] = []
    swung, cost = np.inf, 0.0
    for tried in ran:
        made = tried.candidate
        level = _relative(made.policy, last.candidate.policy, moved)
        if tried in loud:
            swung, cost = min(swung, level), max(cost, -tried.utility)
            quiet = [(each, name) for each, name in quiet if STRONGER * each < level]
        elif cost and not -tried.utility <= FELL * cost:
            fallen.append(level)
        elif np.isfinite(tried.utility):
            quiet.append((level, made.id))
    most, by = max(quiet, default=(UNKNOWN_STRENGTH * swung, ""))
    needed = any(most <= STRONGER * level for level in fallen)
    return Quiet(task, last.candidate, moved, most, by, needed)


def calm_ranges(task: Task, history: Sequence[Tried]) -> list[Array]:
    """Return the least range of each input in each candidate's plan and those before it, (m,).

    The plan of a step from a run that swung replays its swings: its own range is no measure. Plans
    of other models are none either.
    """
    least: dict[str, Array] = {}
    found = []
    for made in (tried.candidate for tried in history):
        own = plan_range(made, task)
        least[made.model] = np.minimum(least.get(made.model, own), own)
        found.append(least[made.model])
    return found


def _moved(task: Task, tried: Tried) -> Array:
    """Return the rms motion of each state in a step of a candidate's runs, (n,)."""
    difference = task.model.difference
    steps = np.concatenate([difference(t.states[1:], t.states[:-1]) for t in tried.trials])
    known = np.isfinite(steps)
    squares = np.clip(np.where(known, steps, 0.0), -HUGE, HUGE) ** 2
    return np.asarray(np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)))


def _relative(policy: Policy, other: Policy, moved: Array) -> float:
    """Return the strength of a policy's feedback relative to another's, of the input with most."""
    own, of = (_strength(one, moved) for one in (policy, other))
    return float(np.max(own[of > 0] / of[of > 0], initial=0.0))


def _strength(policy: Policy, moved: Array) -> Array:
    """Return the mean input that moves of each state by `moved` cause by feedback, (m,)."""
    if policy.gain is None:
        return np.zeros(len(policy.low))
    states = np.abs(policy.gain[:, :, : len(moved)])
    return np.asarray((states @ moved).mean(axis=0))
