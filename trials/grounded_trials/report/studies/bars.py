"""Draws the studies whose picture is bars, one number per row."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from grounded.experiments.baselines import BUDGET, SHARES, BaselinesResult, Line
from grounded.experiments.car import PAPER
from grounded.experiments.estimated import CAMERA, WAYS, EstimatedResult
from grounded.experiments.fit_car import FitCarResult
from grounded.experiments.footnote9 import Footnote9Result
from grounded.experiments.jobs import improvement
from grounded.experiments.nondeterminism import NondeterminismResult
from grounded.figures.figure import Bar, Bars, Figure, Key

LEVEL = 2  # index of SHARES: the share of the gap to close in the picture of the baselines
PAPER_SPREAD = 50.0  # [cm] largest distance reported in the paper
KINDS = {
    "parametric": "parametric error",
    "structural": "structural error",
    "noise": "structural error and noise",
}
WORDS = {"camera": "estimated", "true": "true states"}
QUANTITIES = (("Position", "mm", 1e3), ("Heading", "mrad", 1e3), ("Speed", "m/s", 1.0))


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
    return Figure("footnote9", title, "", (panel,), _discs(**kinds))


def nondeterminism_figure(result: NondeterminismResult) -> Figure:
    """Draw the largest distance between end points, by scatter and sequence, on one scale."""
    roles = ("other", "best", "model")
    bars, keys = [], []
    for i, level in enumerate(sorted({s.level for s in result.spreads})):
        role = roles[min(i, len(roles) - 1)]
        keys.append(Key(role, f"scatter x{level:g}", "disc"))
        for s in result.spreads:
            if s.level == level:
                cm = 100 * s.largest
                bars.append(Bar(f"{s.sequence}, x{level:g}", cm, f"{cm:.1f} cm", role))
    bars.append(Bar("the paper’s car, at most", PAPER_SPREAD, f"{PAPER_SPREAD:.0f} cm", "desired"))
    panel = Bars(f"Largest distance between end points, {result.runs} runs of 2 s", tuple(bars))
    return Figure("nondeterminism", "Repeated runs with the same inputs", "", (panel,), tuple(keys))


def baselines_figure(result: BaselinesResult) -> Figure:
    """Draw the real trials that each method needs, one panel per manoeuvre and kind of error."""
    panels = []
    for manoeuvre, kind in dict.fromkeys((line.manoeuvre, line.kind) for line in result.lines):
        own = [li for li in result.lines if (li.manoeuvre, li.kind) == (manoeuvre, kind)]
        methods = dict.fromkeys(line.method for line in own)
        bars = tuple(_method([line for line in own if line.method == m]) for m in methods)
        panels.append(Bars(f"{manoeuvre}, {KINDS.get(kind, kind)}", bars))
    key = _discs(best="this tool", other="other methods", model="not reached by most seeds")
    title = f"Real trials to close {SHARES[LEVEL]:.0%} of the gap, median; bars end at {BUDGET}"
    return Figure("baselines", title, "", tuple(panels), key)


def _method(lines: Sequence[Line]) -> Bar:
    counts = [np.inf if li.trials[LEVEL] is None else float(li.trials[LEVEL] or 0) for li in lines]
    median, name = float(np.median(counts)), lines[0].method
    if not np.isfinite(median):
        end = float(np.median([line.final for line in lines]))
        return Bar(name, float(BUDGET), f"not reached: ends at {end:.1%}", "model")
    role = "best" if name == "grounded" else "other"
    return Bar(name, min(median, BUDGET), f"{median:g}", role)


def fit_car_figure(result: FitCarResult) -> Figure:
    """Draw by parameter: coverage of the intervals, rms error, and calibration of the std."""
    held, gained, honest = [], [], []
    count = len(result.runs)
    for name, share in result.coverage.items():
        each = [run["params"][name] for run in result.runs]
        first, last = (
            float(np.sqrt(np.mean([(p[key] - p["true"]) ** 2 for p in each])))
            for key in ("first", "value")
        )
        z = float(np.sqrt(np.mean([((p["value"] - p["true"]) / p["std"]) ** 2 for p in each])))
        held.append(Bar(name, share, f"{round(share * count)} of {count}"))
        ratio = last / first if first > 0 else np.nan
        text = f"{last:.2g} {each[0]['unit']}".removesuffix(" 1")
        gained.append(Bar(name, ratio, f"{ratio:.1%}: {text}"))
        honest.append(Bar(name, z, f"{z:.2f}"))
    panels = (
        Bars("Cars whose 95 % interval contains the true value", tuple(held)),
        Bars("Rms error of the fit, relative to that of the initial value", tuple(gained)),
        Bars("Rms error of the fits in their own standard deviations", tuple(honest)),
    )
    title = f"Parameters from {result.minutes:g} minutes of driving, {count} cars"
    return Figure("fit-car", title, "", panels)


def estimated_figure(result: EstimatedResult) -> Figure:
    """Draw the improvement with estimated and with true states, and the estimation errors."""
    names = list(dict.fromkeys(run.manoeuvre for run in result.runs))
    bars = [bar for name in names for bar in _gains(result, name)]
    panels = [Bars("Reduction of the model’s cost", tuple(bars))]
    for i, (what, unit, factor) in enumerate(QUANTITIES):
        rows = [bar for name in names for bar in _errors(result, name, i, unit, factor)]
        if rows:
            panels.append(Bars(f"{what}: rms estimation error", tuple(rows)))
    others = "optimum, and the paper’s car"
    key = _discs(best="on estimated states", accepted="on true states", other=others)
    title = f"The closed loop on estimated states, markers ±{1e3 * CAMERA:g} mm"
    return Figure("estimated", title, "", tuple(panels), key)


def _gains(result: EstimatedResult, name: str) -> list[Bar]:
    bars, best = [], math.nan
    for way, role in zip(WAYS, ("best", "accepted"), strict=True):
        runs = result.of(name, way)
        if runs:
            gain = float(np.mean([run.improvement for run in runs]))
            bars.append(Bar(f"{name}, {WORDS[way]}", gain, f"{gain:.1%}", role))
            best = float(np.mean([improvement(run.true[0], run.true[2]) for run in runs]))
    bars.append(Bar(f"{name}, optimum", best, f"{best:.1%}", "other"))
    return [*bars, Bar(f"{name}, the paper’s", PAPER[name], f"{PAPER[name]:.0%}", "other")]


def _errors(result: EstimatedResult, name: str, which: int, unit: str, factor: float) -> list[Bar]:
    """Return the rms estimation errors of one quantity, live and smoothed, of the camera runs."""
    runs = [run for run in result.of(name, "camera") if run.live]
    bars = []
    for words in ("live filter", "smoother") if runs else ():
        found = np.array([run.live if words == "live filter" else run.smoothed for run in runs])
        rms = factor * float(np.sqrt(np.mean(found[:, which] ** 2)))
        bars.append(Bar(f"{name}, {words}", rms, f"{rms:.3g} {unit}"))
    return bars


def _discs(**names: str) -> tuple[Key, ...]:
    """Return a legend of discs, given as role = name."""
    return tuple(Key(role, name, "disc") for role, name in names.items())
