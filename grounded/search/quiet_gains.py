"""Keep feedback at the strength that ran quietly, once feedback made a robot's inputs oscillate.

An arm of a search swung, and its next candidate, with 44 % of the gains, ran quietly but lost: dry
friction held it back. The step after it had all of the gains again, and ended in a limit cycle
between the limits of both motors. What a loop lacks to be stable (a delay, a filter) is not in the
model, so no prediction shows it; runs do. So the strength of a policy's feedback, input by input,

    mean over t of sum_j |K_tij| d_j,    d_j = rms motion of state j in a step of the run that swung

is compared with that of what ran. After a run that oscillated no later policy of the same model is
stronger than the strongest that ran quietly, or, if none weaker than that run did, than half of it.
A stronger one that runs quietly all the same moves the bound up again. A run that failed, or whose
cost is many times that of the one that swung, shows the opposite, that the robot needs its gains:
then there is no bound, but candidates say what they risk (`risk`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.candidate import Candidate, Tried
from grounded.search.limit_cycle import limit_cycle, plan_range
from grounded.task import Task

HALF = 0.5  # share of the strength that oscillated, if none weaker than that ran quietly
FELL = 10.0  # cost, relative to the run that swung, above which gentler feedback is too weak
HUGE = 1e100  # bound on the motion of a diverged run in a step, in the state's unit
STRONGER = 1.05  # ratio to the bound from which feedback counts as stronger


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

    def risk(self, made: Candidate) -> str:
        """Return a sentence if a candidate's feedback is stronger than what ran quietly; or ""."""
        if self.allows(made.policy):
            return ""
        strength, swung, name = self.strength(made.policy), self.swung.id, made.id
        weaker = f", while that of {self.by}, {100 * self.most / strength:.0f} % as strong, did not"
        weaker = weaker * bool(self.by) + ", but much weaker feedback did far worse" * self.needed
        if name == swung:
            told = f"the feedback of {name} made inputs oscillate when it ran{weaker}"
        else:
            told = (
                f"the feedback of {swung} made inputs oscillate{weaker}, and that of {name} is "
                f"{100 * strength:.0f} % as strong as that of {swung}"
            )
        return f"{told}: be ready to stop the robot"


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
    most, by = max(quiet, default=(HALF * swung, ""))
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
