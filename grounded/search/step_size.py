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
count against steps with corrected ones (`mispredictions`). If the damping penalty is small beside
the other weights, ten times the damping gives nearly the same step; a step that the model runs
nearly as one that lost is skipped.

Real trials are the evaluations of this line search, so it is not a loop but a function of the
trials so far. A step is also skipped if its predicted run leaves the safe region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from grounded.result import figure

KEPT, BROKEN = 0.9, 0.25
EASED, RAISED = 30.0, 10.0
LEAST, MOST = 1e-6, 1e3


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
    if step.alpha == 1.0 and real >= KEPT * predicted:
        return Step(max(step.damping / EASED, LEAST))
    if real < BROKEN * predicted:
        return Step(min(step.damping * RAISED, MOST))
    return Step(step.damping)


def after_failure(step: Step, max_halvings: int, *, damps: bool = True) -> Step | None:
    """Return the next, more cautious step; None if the line search has failed (step 7).

    Args:
        step: the step that did not improve the utility.
        max_halvings: smallest alpha is 2^-max_halvings.
        damps: whether the damping is raised before alpha is halved.
    """
    if damps and step.damping < MOST:
        return replace(step, damping=min(step.damping * RAISED, MOST))
    alpha = step.alpha / 2
    return replace(step, alpha=alpha) if alpha >= 2.0**-max_halvings * (1 - 1e-12) else None
