"""Steps 6 and 7: how large a step is tried next on the REAL system, after what trials have shown.

A step is two numbers:

    damping   lambda in [0, 1000]: the price lambda (R + S) |u - u_trial|^2 on leaving the trial's
              inputs, within which DDP converges (`directions.damped`)
    alpha     the paper's step along the direction that results: 1, then halved (footnote 11)

At lambda = 1 the step is the cautious one that a crude model deserves; at 0 it is the paper's, DDP
to convergence. Neither is right for every robot: on a car with unmodelled effects converged steps
stall, and on the aircraft, whose model predicts gains to a per cent, damped ones are still 4 to
172 % from the optimum after five iterations (docs/experiments.md). So the predictions that came
true decide (Levenberg 1944, Marquardt 1963; the ratio of Conn, Gould & Toint, *Trust-Region
Methods*, 2000, section 6.1):

    rho = real gain / predicted gain   of the last accepted step
    rho >= 0.9 at alpha = 1            lambda / 30
    rho <  0.25                        10 lambda, at most 1000
    a trial without improvement        10 lambda, at most 1000, and from there alpha / 2

Damping goes on rising where the paper halves alpha: a damped step is the best one of its length in
the grounded model, a halved one a mixture of two policies that neither was planned for. With
`[search] step = "full"` alpha is halved from the start, as the paper has it.

That holds among steps by the same slopes: the crude model's losses say nothing of steps by slopes
that trials have corrected (`mispredictions`). And where mu is small beside the other prices, ten
times the damping is the same step: one that the model runs nearly as one that lost is passed over.

Real trials are the evaluations of this line search, so it is no loop but a question put to the
trials so far. A step may also be passed over because its predicted run leaves the safe region.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from grounded.result import figure

KEPT, BROKEN = 0.9, 0.25
EASED, RAISED = 30.0, 10.0
LEAST, MOST = 1e-6, 1e3


@dataclass(frozen=True)
class Step:
    """What is tried next: damping lambda and step size alpha."""

    damping: float = 1.0
    alpha: float = 1.0

    def __str__(self) -> str:
        return f"alpha = {self.alpha:g}" + f", damping {figure(self.damping, 2)}" * (
            self.damping > 0
        )


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


def after_failure(step: Step, max_halvings: int, *, damps: bool = True) -> Step | None:
    """The next, more cautious step; None when the search has failed (step 7).

    Args:
        step: the one that did not improve the utility.
        max_halvings: alpha goes down to 2^-max_halvings.
        damps: whether the damping is raised before alpha is halved.
    """
    if damps and step.damping < MOST:
        return replace(step, damping=min(step.damping * RAISED, MOST))
    alpha = step.alpha / 2
    return replace(step, alpha=alpha) if alpha >= 2.0**-max_halvings * (1 - 1e-12) else None
