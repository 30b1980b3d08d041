"""Pictures of trends: Theorem 1 over epsilon, the rules of the line search over the scatter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from grounded.experiments.noise import NoiseResult, Outcome
from grounded.experiments.theorem1 import Theorem1Result, Theorem1Row
from grounded.frozen import Array
from grounded_trials.figures import Curve, Dot, Figure, Key, Panel, legend

RULE_ROLES = ("model", "step2", "accepted", "best", "other", "predicted", "desired")
SMALLEST = 1e-300  # instead of the logarithm of nothing


def theorem1_figure(result: Theorem1Result) -> Figure:
    """Gradient error and squared gradient over epsilon, log-log, with the theorem's slopes."""
    slopes = result.slopes()
    panels = (
        _trend(result, "Gradient error", lambda row: row.error, slopes["gradient_error"], 1),
        _trend(
            result,
            "Squared gradient at the end",
            lambda row: row.squared,
            slopes["squared_gradient"],
            2,
            bound=lambda row: 2 * (row.K * row.epsilon) ** 2,
        ),
    )
    key = (
        Key("best", "median of the seeds"),
        Key("best", "each seed", "ring"),
        Key("desired", "the theorem’s slope through it"),
        Key("model", "the theorem’s bound, at its lowest"),
    )
    return Figure("theorem1", "Theorem 1: a model wrong by epsilon", "", panels, key)


def _trend(
    result: Theorem1Result,
    name: str,
    value: Callable[[Theorem1Row], float],
    slope: tuple[float, float],
    theory: int,
    bound: Callable[[Theorem1Row], float] | None = None,
) -> Panel:
    """A quantity by epsilon: a ring a seed, the median, a line of the theorem's slope."""
    rows = result.rows
    dots = tuple(
        Dot(_log(r.epsilon), _log(value(r)), "best", f"seed {r.seed}: {value(r):.3g}", "ring")
        for r in rows
    )
    epsilons = sorted({row.epsilon for row in rows})
    groups = [[row for row in rows if row.epsilon == epsilon] for epsilon in epsilons]
    x = np.array([_log(epsilon) for epsilon in epsilons])
    y = np.array([_log(float(np.median([value(row) for row in own]))) for own in groups])
    line = y.mean() + theory * (x - x.mean())
    curves = [Curve(x, y, "best", "median", 2.0), Curve(x, line, "desired", "theorem", 1.2)]
    if bound is not None:
        lowest = np.array([_log(min(bound(row) for row in own)) for own in groups])
        curves.append(Curve(x, lowest, "model", "bound"))
    error = f" ± {slope[1]:.3f}" if np.isfinite(slope[1]) else ""
    title = f"{name}: slope {slope[0]:.3f}{error}, theorem {theory}"
    return Panel(title, "log₁₀ epsilon", "log₁₀ of it", tuple(curves), dots)


def _log(value: float) -> float:
    return float(np.log10(max(value, SMALLEST)))


def noise_figure(result: NoiseResult) -> Figure:
    """Share of the gap closed by each rule over the scatter: the median seed and the worst."""
    panels = []
    for name in dict.fromkeys(o.manoeuvre for o in result.outcomes):
        own = [o for o in result.outcomes if o.manoeuvre == name]
        panels.append(_shares(own, f"{name}: gap closed, median of the seeds", np.median))
        if len({o.seed for o in own}) > 1:
            panels.append(_shares(own, f"{name}: gap closed, the worst seed", np.min))
    title = f"The line search under noise; recommended: {result.recommended}"
    return Figure("noise", title, "", tuple(panels), legend(panels))


def _shares(outcomes: Sequence[Outcome], title: str, of: Callable[[Array], Any]) -> Panel:
    """A curve a rule."""
    curves, dots = [], []
    for k, rule in enumerate(dict.fromkeys(o.rule for o in outcomes)):
        own = [o for o in outcomes if o.rule == rule]
        levels = sorted({o.level for o in own})
        shares = [
            100 * float(of(np.array([o.closed for o in own if o.level == level])))
            for level in levels
        ]
        role = RULE_ROLES[k % len(RULE_ROLES)]
        curves.append(Curve(np.array(levels), np.array(shares), role, rule))
        dots += [
            Dot(x, y, role, f"{rule}, scatter x{x:g}: {y:.1f} %")
            for x, y in zip(levels, shares, strict=True)
        ]
    return Panel(title, "scatter, times the car’s own", "%", tuple(curves), tuple(dots))
