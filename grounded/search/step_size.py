"""Trust: how far the model's promise is believed, read off the trials that kept or broke it.

Two numbers say which step is tried next on the real system:

    damping   lambda in [0, 1000]: the price lambda (R + S) |u - u_trial|^2 on leaving the trial's
              inputs, within which DDP converges (`improve.damped`)
    alpha     the paper's step along the direction that results, 1, 1/2, 1/4 ...

At lambda = 1 the step is the cautious one that a crude model deserves; at 0 it is the paper's, DDP
to convergence. Neither is right for every robot: on a car with unmodelled effects converged steps
stall, and on the aircraft, whose model keeps its promises to a per cent, damped ones are still 4
to 172 % from the optimum after five iterations (docs/experiments.md). So the promise decides
(Levenberg 1944, Marquardt 1963; the ratio of Conn, Gould & Toint, *Trust-Region Methods*, 2000,
section 6.1):

    rho = real gain / predicted gain   of the last accepted step
    rho >= 0.9 at alpha = 1            lambda / 30
    rho <  0.25                        10 lambda, at most 1
    a trial without improvement        10 lambda, at most 1000, and from there alpha / 2

Why damping goes on rising where the paper halves alpha: a damped step is the best one of its length
in the grounded model, a halved one is a mixture of two policies that neither was planned. On a
cart-pole with a friction that its model lacks, damping ends within 0.1 % of the optimum in 11
trials; halving stops 2.4 % off after 30 (docs/experiments.md). With `[search] step = "full"` alpha
is halved from the start, as the paper has it.

Steps 6 and 7: the line search on the REAL system.

alpha = 1 first, then halved until a trial improves the utility (footnote 11). Real trials are the
evaluations, so the search is not a loop but a question put to the trials so far: which alpha is
next? An alpha may also be passed over because its predicted run leaves the safe region.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

KEPT, BROKEN = 0.9, 0.25
EASED, RAISED = 30.0, 10.0
LEAST, MOST = 1e-6, 1e3


@dataclass(frozen=True)
class Step:
    """What is tried next: damping lambda and step size alpha."""

    damping: float = 1.0
    alpha: float = 1.0


def after_success(step: Step, predicted: float, real: float) -> Step:
    """The first step of the next iteration.

    Args:
        step: the accepted one.
        predicted: gain of utility that the biased model promised.
        real: gain that the trial brought.
    """
    if step.alpha == 1.0 and real >= KEPT * predicted:
        return Step(max(step.damping / EASED, LEAST))
    if real < BROKEN * predicted:
        return Step(min(step.damping * RAISED, MOST))
    return Step(step.damping)


def after_failure(step: Step, max_halvings: int) -> Step | None:
    """A more cautious step along the way down; None when the search has failed (step 7)."""
    if step.damping < MOST:
        return Step(min(step.damping * RAISED, MOST), step.alpha)
    alpha = step.alpha / 2
    return Step(MOST, alpha) if alpha >= 2.0**-max_halvings * (1 - 1e-12) else None


def next_alpha(tried: Iterable[float], max_halvings: int) -> float | None:
    """The step to try after those that did not improve; None when the search has failed (step 7).

    Args:
        tried: alphas of the trials along this direction that did not improve the utility.
        max_halvings: alphas go down to 2^-max_halvings.
    """
    smallest = min(tried, default=2.0)
    alpha = smallest / 2
    return alpha if alpha >= 2.0**-max_halvings * (1 - 1e-12) else None
