"""Pictures of trends: Theorem 1 over epsilon, the rules of the line search over the scatter.

The picture of each of the paper's studies, drawn as the page draws its figures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.experiments.repeats import NoiseResult, Outcome
from grounded.experiments.theorem1 import Theorem1Result, Theorem1Row
from grounded.frozen import Array
from grounded_trials.report.figures.figure import Curve, Dot, Figure, Key, Panel, legend
from grounded_trials.report.figures.png import png
from grounded_trials.report.studies.bars import (
    baselines_figure,
    estimated_figure,
    fit_car_figure,
    footnote9_figure,
    nondeterminism_figure,
)
from grounded_trials.report.studies.paths import car_figure, flight_figure
from grounded_trials.store.store import write_atomically

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


PICTURES: dict[str, Callable[[Any], Figure]] = {
    "flight": flight_figure,
    "car": car_figure,
    "fit-car": fit_car_figure,
    "estimated": estimated_figure,
    "nondeterminism": nondeterminism_figure,
    "footnote9": footnote9_figure,
    "theorem1": theorem1_figure,
    "baselines": baselines_figure,
    "noise": noise_figure,
}


def draw_study(name: str, result: Any, path: Path) -> None:
    """Writes the picture of a study's result as a PNG file.

    Args:
        name: of the study, as in `grounded experiment NAME`.
        result: what its function returned.
        path: of the file; its folder is made.

    Raises:
        GroundedError: if the name is unknown or the file can't be written.
    """
    if name not in PICTURES:
        raise GroundedError(f"no picture of '{name}', only of {', '.join(PICTURES)}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise GroundedError(f"{path.parent} can't be made: {error.strerror}") from None
    write_atomically(path, png(PICTURES[name](result)))
