"""Steps 6 and 7: choose the size of the next step on the REAL system from the trials so far.

A step has two numbers:

    damping   lambda in [0, 1000]: a penalty lambda (R + S) |u - u_trial|^2 on leaving the trial's
              inputs, with which DDP runs to convergence (`directions.damped`)
    alpha     the paper's step size along the resulting direction: 1, then halved (footnote 11)

lambda = 1 gives a cautious step, as suits a crude model; lambda = 0 gives the paper's step, DDP to
convergence. Neither suits every robot: on a car with unmodelled effects converged steps stall; on
the aircraft, whose model predicts gains to one per cent, damped steps are still 4 to 172 % from the
optimum after five iterations (docs/experiments.md). So the accuracy of the last prediction decides
(Levenberg 1944, Marquardt 1963; the ratio of Conn, Gould & Toint, *Trust-Region Methods*, 2000,
section 6.1):

    rho = real gain / predicted gain   of the last accepted step
    rho >= 0.9 at alpha = 1            lambda / 30
    rho <  0.25                        10 lambda, at most 1000
    a trial without improvement        10 lambda, at most 1000, and from there alpha / 2

Damping is raised before alpha is halved because a damped step is the best step of its length in the
grounded model, whereas a halved step mixes two policies and is not planned as such. With
`[search] step = "full"` alpha is halved from the start, as in the paper.

This applies among steps with the same derivatives: losses with the crude model's derivatives do not
count against steps with corrected ones (`mispredictions`).

Real trials are the evaluations of this line search, so it is not a loop but a function of the
trials so far. A step is also skipped if its predicted run leaves the safe region.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np

from grounded.checks import one_of, whole_number, wrong
from grounded.result import figure
from grounded.search.candidate import BY_STEP, Candidate, Slopes, Tried, Way

KEPT_PROMISE, BROKEN_PROMISE = 0.9, 0.25
EASED, RAISED = 30.0, 10.0
SMALLEST_DAMPING, LARGEST_DAMPING = 1e-6, 1e3
Method = Literal["ddp", "policy-gradient"]
Stepping = Literal["damped", "full"]
METHODS, STEPS = get_args(Method), get_args(Stepping)
OTHERS = 2  # losses from a candidate before its derivatives are corrected step by step, and after


@dataclass(frozen=True)
class Step:
    """The damping lambda and the step size alpha of a step."""

    damping: float = 1.0
    alpha: float = 1.0

    def __str__(self) -> str:
        return f"alpha = {self.alpha:g}" + f", damping {figure(self.damping, 2)}" * (
            self.damping > 0
        )


def after_success(step: Step, predicted: float, real: float) -> Step:
    """Return the first step of the next iteration.

    Args:
        step: the accepted step.
        predicted: gain of utility that the grounded model predicted.
        real: gain of utility in the trial.
    """
    if step.alpha == 1.0 and real >= KEPT_PROMISE * predicted:
        return Step(max(step.damping / EASED, SMALLEST_DAMPING))
    if real < BROKEN_PROMISE * predicted:
        return Step(min(step.damping * RAISED, LARGEST_DAMPING))
    return Step(step.damping)


def after_failure(step: Step, max_halvings: int, *, damps: bool = True) -> Step | None:
    """Return the next, more cautious step; None if the line search has failed (step 7).

    The smallest alpha is 2^-max_halvings; `damps`: the damping is raised before alpha is halved.
    """
    if damps and step.damping < LARGEST_DAMPING:
        return replace(step, damping=min(step.damping * RAISED, LARGEST_DAMPING))
    alpha = step.alpha / 2
    return replace(step, alpha=alpha) if alpha >= 2.0**-max_halvings * (1 - 1e-12) else None


@dataclass(frozen=True)
class SearchOptions:
    """Settings of a search; the [search] table of grounded.toml (docs/configuration.md).

    Args:
        method: algorithm that makes a direction: "ddp" or "policy-gradient".
        step: "damped" raises the damping before alpha is halved; "full" only halves alpha, as in
            the paper.
        refit: fit the model's uncertain parameters to all trials before each proposal.
        match_inputs: attribute what shifted inputs explain to the inputs, and only the rest to the
            bias; False for the paper's bias alone.
        max_halvings: smallest step size is alpha = 2^-max_halvings, 0 to 30.
        repeats: trials of each candidate, 1 to 100.
        rerun_incumbent: run the best candidate again if a loss to it may be due to noise.
        max_trials: the search stops after this many trials.
        tolerance: the search ends when the model predicts a smaller relative gain, 0 to below 1.

    Raises:
        GroundedError: if a setting has another type, is not one of the choices, or out of range.
    """

    method: Method = "ddp"
    step: Stepping = "damped"
    refit: bool = False
    match_inputs: bool = True
    max_halvings: int = 6
    repeats: int = 1
    rerun_incumbent: bool = True
    max_trials: int = 40
    tolerance: float = 1e-3

    def __post_init__(self) -> None:
        for name, valid in (("method", METHODS), ("step", STEPS)):
            one_of(f"[search] {name}", getattr(self, name), valid)
        for name in ("refit", "match_inputs", "rerun_incumbent"):
            if not isinstance(given := getattr(self, name), bool | np.bool_):
                raise wrong(f"[search] {name}", given, must="bool")
        bounds = {"max_halvings": (0, 30), "repeats": (1, 100), "max_trials": (1, 100_000)}
        for name, (low, high) in bounds.items():
            whole_number(f"[search] {name}", getattr(self, name), low, high)
        whole_number("[search] repeats", self.repeats, 1, self.max_trials)
        tolerance: Any = self.tolerance
        if not isinstance(tolerance, int | float | np.number) or not 0 <= tolerance < 1:
            raise wrong("[search] tolerance", tolerance, low=0, below=1)

    @property
    def damps(self) -> bool:
        """Whether steps are also damped (see `step_size`), not only halved as in the paper."""
        return self.method == "ddp" and self.step == "damped"

    def first_step(self) -> Step:
        """Return the first step along a new direction, before any prediction was tested."""
        return Step(damping=1.0 if self.damps else 0.0)

    def next_step(self, step: Step) -> Step | None:
        """Return the step after one that did not improve; None if no smaller one is left."""
        return after_failure(step, self.max_halvings, damps=self.damps)

    def due(
        self,
        history: Sequence[Tried],
        incumbent: Tried,
        model: str,
        way: Way = "",
        slopes: Slopes | None = None,
    ) -> Step | None:
        """Return the next step from the incumbent, made in one way; None if that is exhausted.

        Only losses of the same model (and of the same kind of derivatives, `slopes`, if given)
        count: a direction belongs to one model.
        """
        made = incumbent.candidate
        losers = losers_of(history, made.id, model, way)
        goes_on = made.way == way and made.model == model
        if way == BY_STEP:
            enough = goes_on or len(losers_of(history, made.id, model)) >= OTHERS
            used_up = len(losers) >= OTHERS and not goes_on
            scatters = incumbent.standard_error > 0  # one way is enough to be told from luck
            if scatters or used_up or not (self.damps and enough):
                return None
        if slopes is not None:
            losers = [candidate for candidate in losers if candidate.slopes == slopes]
        if losers:
            return self.next_step(Step(losers[-1].damping, losers[-1].alpha))
        base = next((t for t in history if t.candidate.id == made.base), None)
        if base is None or not goes_on or not self.damps:
            first = self.first_step()
            return self.next_step(first) if way == BY_STEP else first
        real = incumbent.gain_over(base)
        return after_success(Step(made.damping, made.alpha), made.predicted_gain, real)

    def steps_from(self, step: Step | None) -> Iterator[Step]:
        """Yield the due step, then ever more cautious steps."""
        while step is not None:
            yield step
            step = self.next_step(step)


def losers_of(
    history: Sequence[Tried], base: str, model: str, way: Way | None = None
) -> list[Candidate]:
    """Return those made from `base` in this model, in this way if any, that did not improve."""
    found = list[Candidate]()
    for tried in history:
        made = tried.candidate
        if (made.base, made.model) == (base, model) and tried.lost and way in (None, made.way):
            found.append(made)
    return found
