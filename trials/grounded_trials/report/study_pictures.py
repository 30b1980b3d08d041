"""Draws the picture of each of the paper's studies, in the style of the report's figures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import known
from grounded.experiments.car import PAPER, CarResult, CarRun
from grounded.experiments.figure8 import DT
from grounded.experiments.flight import FIGURE_STEP, FlightResult
from grounded.experiments.footnote9 import Footnote9Result
from grounded.experiments.jobs import mean_se
from grounded.experiments.theorem1 import Theorem1Result, Theorem1Row
from grounded.figures.figure import (
    STEPS,
    WIDTHS,
    Bar,
    Bars,
    Curve,
    Dot,
    Figure,
    Key,
    Panel,
    Rule,
    enlarging,
    legend,
)
from grounded.frozen import Array
from grounded_trials.report.figures.png import png
from grounded_trials.store.store import made_folder, write_atomically

FIRST, LAST, DESIRED = "the model’s controller", "after learning", "desired"
PAPER_FIGURE = {"turn": 4, "circle": 5, "figure8": 5}
SMALLEST = 1e-300  # lower bound of arguments of the logarithm


def flight_figure(result: FlightResult) -> Figure:
    """Draw Figure 1: North over East (also enlarged), altitude over time, and utilities."""
    shown = result.representative
    after = f"after {len(shown.utilities) - 1} iterations"
    paths = [
        ("model", FIRST, np.array(shown.paths["model"])),
        ("best", after, np.array(shown.paths["learned"])),
        ("desired", DESIRED, np.array(result.desired)),
    ]
    times = np.arange(len(result.desired), dtype=np.float64) * DT * FIGURE_STEP
    height = [Curve(times[: len(p)], p[:, 2], role, name) for role, name, p in paths]
    factor = enlarging(paths[0][2], paths[2][2])
    panels = (
        _plane("Figure 1: North over East", paths, 1.0),
        _plane(f"The same, deviations {factor:g} times enlarged", paths, factor),
        Panel("Figure 1: altitude above the start", "time [s]", "m", tuple(height)),
        _utilities(result),
    )
    more, of = {"accepted": "optimum with the true parameters"}, ""
    if len(result.flown) > 1:
        more["other"] = "utilities of the other runs"
        of = f"the median of {len(result.flown)} runs, "
    key = (*legend(panels[:1]), *(Key(role, name) for role, name in more.items()))
    title = f"The aircraft’s figure-8: {of}seed {shown.seed}"
    return Figure("flight", title, "", panels, key)


def _plane(title: str, paths: list[tuple[str, str, Array]], factor: float) -> Panel:
    """Draw paths from above, with deviations from the desired one enlarged by `factor`."""
    desired = paths[-1][2]
    curves = []
    for role, name, path in paths:
        near = desired[: len(path)]
        p = near + factor * (path - near)
        curves.append(Curve(p[:, 1], p[:, 0], role, name, WIDTHS.get(role, 1.5)))
    return Panel(title, "East [m]", "North [m]", tuple(curves), equal=True)


def _utilities(result: FlightResult) -> Panel:
    """Draw utility by iteration, one line per run, and the optimum with the true parameters."""
    curves = []
    for run in sorted(result.flown, key=lambda run: run is result.representative):
        x, y = np.arange(len(run.utilities), dtype=np.float64), np.array(run.utilities)
        role, width = ("best", 2.0) if run is result.representative else ("other", 1.0)
        curves.append(Curve(x, y, role, f"run {run.seed}", width))
    title, x_name = "Utility of every run, logarithmic", "iteration (0: the model’s controller)"
    rules = (Rule(result.optimum, "accepted", "optimum"),)
    return Panel(title, x_name, "utility", tuple(curves), rules=rules, loss=True, whole=True)


def car_figure(result: CarResult) -> Figure:
    """Draw Figure 4 (the turn by iteration), Figure 5 (circle and figure-8) and improvements.

    Paths are those of the first seed, with scatter if that was run.
    """
    names = list(dict.fromkeys(run.manoeuvre for run in result.runs))
    shown = [(result.of(name, True) or result.of(name, False))[0] for name in names]
    panels = [_manoeuvre(run, stages=run.manoeuvre == "turn") for run in shown]
    key = [Key("desired", DESIRED), Key("model", FIRST)]
    for run in (run for run in shown if run.manoeuvre == "turn"):
        between = len(run.paths) - 3  # without the target, the first and the last
        told = [f"iteration {i + 1}" for i in range(min(between, len(STEPS)))]
        if between > len(STEPS):
            told[-1] += " and later"
        key += [Key(role, name) for role, name in zip(STEPS, told, strict=False)]
    key.append(Key("best", LAST))
    return Figure("car", "The RC car", "", (*panels, _improvements(result, names)), tuple(key))


def _manoeuvre(run: CarRun, stages: bool) -> Panel:
    """Draw the paths of the first and last iteration, and with `stages` those between."""
    every = [p for name, p in run.paths.items() if name != "target"]
    roles = ["model", *STEPS, *[STEPS[-1]] * len(every)][: len(every)]
    roles[-1] = "best" if len(every) > 1 else "model"
    curves = []
    for role, path in (*zip(roles, every, strict=True), ("desired", run.paths["target"])):
        if stages or role in ("model", "best", "desired"):
            x, y = np.array(path).T
            curves.append(Curve(x, y, role, role, WIDTHS.get(role, 1.5)))
    number = PAPER_FIGURE.get(run.manoeuvre)
    ending = f"{len(every) - 1} iterations" if len(every) != 2 else "1 iteration"
    words = "with scatter" if run.noisy else "repeats itself"
    title = f"Figure {number}: {run.manoeuvre}, {words}, {ending}"
    return Panel(title, "x [m]", "y [m]", tuple(curves), equal=True)


def _improvements(result: CarResult, names: Sequence[str]) -> Bars:
    """Draw the reduction of the cost, with that of the paper."""
    bars = []
    for name in names:
        for noisy, words in ((False, "repeats itself"), (True, "with scatter")):
            gains = [run.improvement for run in result.of(name, noisy)]
            if gains:
                mean, _ = mean_se(gains)
                bars.append(Bar(f"{name}, {words}", mean, f"{mean:.1%}"))
        bars.append(Bar(f"{name}, the paper’s car", PAPER[name], f"{PAPER[name]:.0%}", "other"))
    return Bars("Reduction of the model’s cost", tuple(bars))


def theorem1_figure(result: Theorem1Result) -> Figure:
    """Draw gradient error and squared gradient over epsilon, log-log, below the theorem's bounds.

    A bound is drawn with the largest K that was measured.
    """
    slopes, K = result.slopes(), result.measured_K
    panels = (
        _trend(
            result,
            ("Gradient’s error", "log₁₀ |∇Û − ∇U|"),
            lambda row: row.error,
            slopes["gradient_error"],
            lambda epsilon: K * epsilon,
        ),
        _trend(
            result,
            ("|∇U|² at the end", "log₁₀ |∇U|²"),
            lambda row: row.squared,
            slopes["squared_gradient"],
            lambda epsilon: 2 * (K * epsilon) ** 2,
        ),
    )
    key = (
        Key("best", "median of the seeds"),
        Key("best", "each seed", "ring"),
        Key("limit", f"bound with the largest measured K, {K:.3g}"),
    )
    return Figure("theorem1", "Theorem 1: a model wrong by epsilon", "", panels, key)


def _trend(
    result: Theorem1Result,
    names: tuple[str, str],
    value: Callable[[Theorem1Row], float],
    slope: tuple[float, float],
    bound: Callable[[float], float],
) -> Panel:
    """Draw a quantity (title, axis) by epsilon: a ring per seed, the median, and its bound."""
    rows = result.rows
    dots = tuple(
        Dot(_log(r.epsilon), _log(value(r)), "best", f"seed {r.seed}: {value(r):.3g}", "ring")
        for r in rows
    )
    epsilons = sorted({row.epsilon for row in rows})
    groups = [[row for row in rows if row.epsilon == epsilon] for epsilon in epsilons]
    x = np.array([_log(epsilon) for epsilon in epsilons])
    y = np.array([_log(float(np.median([value(row) for row in own]))) for own in groups])
    height = np.array([_log(bound(epsilon)) for epsilon in epsilons])
    curves = [Curve(x, y, "best", "median", 2.0), Curve(x, height, "limit", "bound", 1.5)]
    power = round(float(np.log10(bound(10.0) / bound(1.0))))
    error = f" ± {slope[1]:.3f}" if np.isfinite(slope[1]) else ""
    title = f"{names[0]}: slope {slope[0]:.3f}{error}, bound {power}"
    return Panel(title, "log₁₀ epsilon", names[1], tuple(curves), dots)


def _log(value: float) -> float:
    return float(np.log10(max(value, SMALLEST)))


def footnote9_figure(result: Footnote9Result) -> Figure:
    """Draw shares of the optimum for each b: the model's policy, one iteration, policy gradient."""
    kinds = {"model": "model-based", "best": "one iteration", "other": "policy gradient"}
    bars = []
    for row in result.rows:
        values = (row.model_based, row.solved, row.gradient)
        for (role, name), value in zip(kinds.items(), values, strict=True):
            bars.append(Bar(f"b = {row.b:g}, {name}", value, f"{value:.3g}", role))
    title = "Footnote 9: a model that is wrong by b"
    panel = Bars("Real utility as a share of the optimum", tuple(bars))
    return Figure(
        "footnote9",
        title,
        "",
        (panel,),
        tuple(Key(role, name, "disc") for role, name in kinds.items()),
    )


PICTURES: dict[str, Callable[[Any], Figure]] = {
    "flight": flight_figure,
    "car": car_figure,
    "footnote9": footnote9_figure,
    "theorem1": theorem1_figure,
}


def draw_study(name: str, result: Any, path: Path) -> None:
    """Write the picture of a study's result as a PNG file.

    Args:
        name: name of the study, as in `grounded experiment NAME`.
        result: the study's result.
        path: path of the file; its folder is created if needed.

    Raises:
        GroundedError: if the name is unknown or the file can't be written.
    """
    known("picture", [name], PICTURES)
    made_folder(path.parent)
    write_atomically(path, png(PICTURES[name](result)))
