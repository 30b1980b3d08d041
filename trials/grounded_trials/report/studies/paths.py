"""Pictures of paths: the paper's Figure 1 (aircraft), Figures 4 and 5 (car)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.experiments.car import PAPER, CarResult, CarRun
from grounded.experiments.figure8 import DT
from grounded.experiments.flight import FIGURE_STEP, FlightResult
from grounded.experiments.jobs import mean_se
from grounded.frozen import Array
from grounded_trials.report.figures.figure import Bar, Bars, Curve, Figure, Key, Panel, Rule, legend
from grounded_trials.report.figures.runs import STEPS

FIRST, LAST, DESIRED = "the model’s controller", "after learning", "desired"
FACTORS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
PAPER_FIGURE = {"turn": 4, "circle": 5, "figure8": 5}


def flight_figure(result: FlightResult) -> Figure:
    """Figure 1: North-East (also enlarged) and altitude over time; utilities."""
    shown = result.representative
    paths = [
        ("model", FIRST, _array(shown.paths["model"])),
        ("best", f"after {len(shown.utilities) - 1} iterations", _array(shown.paths["learned"])),
        ("desired", DESIRED, _array(result.desired)),
    ]
    times = np.arange(len(result.desired), dtype=np.float64) * DT * FIGURE_STEP
    height = [Curve(times[: len(p)], p[:, 2], role, name) for role, name, p in paths]
    factor = _enlarged(paths[0][2], paths[2][2])
    panels = (
        _plane("Figure 1: North over East", paths, 1.0),
        _plane(f"The same, deviations {factor:g} times as large", paths, factor),
        Panel("Figure 1: altitude above the start", "time [s]", "m", tuple(height)),
        _utilities(result),
    )
    key = (*legend(panels[:1]), Key("other", "utilities of the other runs"))
    key = (*key, Key("accepted", "optimum with the true parameters"))
    title = f"The aircraft’s figure-8: the median of {len(result.flown)} runs, seed {shown.seed}"
    return Figure("flight", title, "", panels, key)


def _enlarged(path: Array, desired: Array) -> float:
    """A round factor that makes the deviation of a path visible beside the desired one's size."""
    off = np.abs(path - desired[: len(path)])[:, :2].max()
    room = 0.2 * np.ptp(desired[:, :2], axis=0).max()
    return max((f for f in FACTORS if f * off <= room), default=1.0)


def _plane(title: str, paths: list[tuple[str, str, Array]], factor: float) -> Panel:
    """Paths from above, each `factor` times as far from the desired one as it was."""
    desired = paths[-1][2]
    curves = []
    for role, name, path in paths:
        near = desired[: len(path)]
        p = near + factor * (path - near)
        curves.append(Curve(p[:, 1], p[:, 0], role, name, _width(role)))
    return Panel(title, "East [m]", "North [m]", tuple(curves), equal=True)


def _utilities(result: FlightResult) -> Panel:
    """Utility by iteration, a line a run, above the optimum with the true parameters."""
    curves = []
    for run in sorted(result.flown, key=lambda run: run is result.representative):
        mine = run is result.representative
        x = np.arange(len(run.utilities), dtype=np.float64)
        role, width = ("best", 2.0) if mine else ("other", 1.0)
        curves.append(Curve(x, _array(run.utilities), role, f"run {run.seed}", width))
    return Panel(
        "Utility of every run, logarithmic",
        "iteration (0: the model’s controller)",
        "utility",
        tuple(curves),
        rules=(Rule(result.optimum, "accepted", "optimum"),),
        loss=True,
    )


def car_figure(result: CarResult) -> Figure:
    """Figure 4, the turn through its iterations; Figure 5, circle and figure-8; improvements."""
    names = list(dict.fromkeys(run.manoeuvre for run in result.runs))
    panels: list[Panel | Bars] = []
    for name in names:
        run = (result.of(name, True) or result.of(name, False))[0]
        panels.append(_manoeuvre(run, stages=name == "turn"))
    stages = any(run.manoeuvre == "turn" for run in result.runs)
    key = [Key("desired", DESIRED), Key("model", FIRST)]
    if stages:
        key += [Key(role, f"iteration {i + 1}") for i, role in enumerate(STEPS)]
    key.append(Key("best", LAST))
    return Figure("car", "The RC car", "", (*panels, _improvements(result, names)), tuple(key))


def _manoeuvre(run: CarRun, stages: bool) -> Panel:
    """The path of the first and the last iteration, and those between."""
    every = [_array(p) for name, p in run.paths.items() if name != "target"]
    roles = ["model", *STEPS, *["other"] * len(every)][: len(every)]
    roles[-1] = "best" if len(every) > 1 else "model"
    chosen = [(role, p) for role, p in zip(roles, every, strict=True)]
    if not stages:
        chosen = [(role, p) for role, p in chosen if role in ("model", "best")]
    chosen.append(("desired", _array(run.paths["target"])))
    curves = tuple(Curve(p[:, 0], p[:, 1], role, role, _width(role)) for role, p in chosen)
    number = PAPER_FIGURE.get(run.manoeuvre)
    ending = f"{len(every) - 1} iterations" if len(every) != 2 else "1 iteration"
    title = f"Figure {number}: {run.manoeuvre}, {ending}"
    return Panel(title, "x [m]", "y [m]", curves, equal=True)


def _improvements(result: CarResult, names: Sequence[str]) -> Bars:
    """Share of the cost that is gone, beside the paper's."""
    bars = []
    for name in names:
        for noisy, words in ((False, "quiet"), (True, "with scatter")):
            gains = [run.improvement for run in result.of(name, noisy)]
            if gains:
                mean, _ = mean_se(gains)
                bars.append(Bar(f"{name}, {words}", mean, f"{mean:.1%}"))
        bars.append(Bar(f"{name}, the paper’s car", PAPER[name], f"{PAPER[name]:.0%}", "other"))
    return Bars("Share of the model’s cost that is gone", tuple(bars))


def _array(values: Sequence[Sequence[float]] | Sequence[float]) -> Array:
    return np.asarray(values, dtype=np.float64)


def _width(role: str) -> float:
    return {"best": 2.5, "desired": 1.0}.get(role, 1.5)
