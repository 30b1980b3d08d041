"""The figures of the gap.

What was diagnosed: where the gap lies, which effects explain it, how far it shrinks. And the gap in
time: the model set on the real state every second, and then left alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from grounded.diagnosis.report import Diagnosis
from grounded.trial import Trial
from grounded_trials.report.figures.axis import fitted, without_astray
from grounded_trials.report.figures.figure import Bar, Bars, Curve, Figure, Panel, legend
from grounded_trials.report.findings import Findings
from grounded_trials.report.forecast import SECONDS, forecast
from grounded_trials.wording import figure, labelled, shown, with_unit

MOST = 12


def gap_figure(diagnosis: Diagnosis | None) -> Figure | None:
    """Shares of the gap by channel, time and region; evidence; the gap before and after."""
    if diagnosis is None:
        return None
    where = diagnosis.where
    by_channel = [
        (c.name, c.share, ", " + with_unit(f"{c.rms:.3g}", c.unit)) for c in where.channels
    ]
    by_time = [(f"{t.start:g} to {t.end:g} s", t.share, "") for t in where.times]
    by_region = [
        (r.when, r.share, f", {100 * r.occupancy:.0f} % of the time") for r in where.regions
    ]
    panels = [
        Bars(f"Share of the gap by {word}", _shares(shares, role))
        for word, shares, role in (
            ("channel", by_channel, "best"),
            ("time", by_time, "step2"),
            ("region", by_region, "accepted"),
        )
        if shares
    ]
    if diagnosis.ranking:
        panels.append(Bars("Evidence for an effect [nats]", _ranking(diagnosis)))
    if diagnosis.gap.measured:
        panels.append(_shrinkage(diagnosis))
    if not panels:
        return None
    caption = (
        "Evidence is the gain in log-likelihood less its price; an effect is claimed from 3 nats. "
        "The floor is what noise alone would leave."
    )
    return Figure("gap", "Gap between model and reality", caption, tuple(panels))


def _shares(shares: Sequence[tuple[str, float, str]], role: str) -> tuple[Bar, ...]:
    """Bars of (label, share, what else is said of it)."""
    return tuple(
        Bar(label, share, f"{100 * share:.0f} %{note}", role)
        for label, share, note in shares[:MOST]
    )


def _ranking(diagnosis: Diagnosis) -> tuple[Bar, ...]:
    named = set(diagnosis.effects)
    return tuple(
        Bar(r.effect, r.evidence, figure(r.evidence, 3), "best" if r.effect in named else "other")
        for r in diagnosis.ranking[:MOST]
    )


def _shrinkage(diagnosis: Diagnosis) -> Bars:
    gap = diagnosis.gap
    title = f"Prediction error {gap.horizon_s:g} s ahead" if math.isfinite(gap.horizon_s) else "Gap"
    rows = (
        ("model", gap.before, "model"),
        ("as diagnosed", gap.after, "best"),
        ("noise alone", gap.floor, "other"),
    )
    return Bars(title, tuple(Bar(name, v, figure(v, 3), role) for name, v, role in rows))


SPAN_S = 30.0  # of a long log that is drawn: the part with the largest errors
LOGS = 2  # that are drawn; the table has all


def forecast_figures(findings: Findings) -> list[Figure]:
    """One for the best run, or else the last, and one for each of the longest logs."""
    found = []
    run = findings.best or findings.latest
    if run is not None:
        title = f"The model {SECONDS:g} s ahead, {run.label}"
        found.append(_figure(findings, "forecast", title, run.trial))
    longest = sorted(findings.logs, key=lambda log: -log.trial.finite_steps)[:LOGS]
    for log in longest:
        title = f"The model {SECONDS:g} s ahead, data {log.trial.id}"
        found.append(_figure(findings, f"data-{log.trial.id}", title, log.trial))
    return [figure for figure in found if figure is not None]


def _figure(findings: Findings, name: str, title: str, trial: Trial) -> Figure | None:
    steps = trial.finite_steps
    if steps < 1:
        return None
    trial, begin = _worst_part(findings, trial)
    crude = forecast(findings.crude, trial)
    if crude is None:
        return None
    better = findings.better
    after = forecast(better.planner, trial) if better is not None else None
    times = np.arange(trial.steps + 1, dtype=np.float64) * trial.dt + begin
    panels = []
    for i, (state, unit) in enumerate(findings.task.model.states.items()):
        t, values = crude.curve(i, trial.dt)
        curves = [
            Curve(times, trial.states[:, i], "real", "real"),
            Curve(t + begin, values, "model", findings.plain, 1.2),
        ]
        if better is not None and after is not None:
            t, values = after.curve(i, trial.dt)
            curves.append(Curve(t + begin, values, "best", f"model {better.name}", 1.2))
        bounds = fitted(without_astray([curves[0].y], [c.y for c in curves[1:]]))
        label = labelled(state, unit)
        panels.append(Panel(label, "time [s]", shown(unit), tuple(curves), y_range=bounds))
    caption = (
        f"Every {SECONDS:g} s the model starts from the measured state and gets the inputs that "
        "were sent: where the lines part, the model is wrong."
    )
    if trial.steps < steps:
        caption += f" Drawn is the worst part of the log, from {begin:g} s on."
    return Figure(name, title, caption, tuple(panels), legend(panels))


def _worst_part(findings: Findings, trial: Trial) -> tuple[Trial, float]:
    """The SPAN_S of a long trial with the largest forecast errors, and when it begins [s]."""
    whole = trial.finite_steps
    span = round(SPAN_S / trial.dt)
    if whole <= span:
        return _part(trial, 0, whole), 0.0
    found = forecast(findings.crude, trial)
    assert found is not None
    kept = found.steps[:, -1] >= 0
    ends = found.steps[kept, -1]
    off = findings.task.model.difference(found.states[kept, -1], trial.states[ends])
    size = np.nan_to_num((off / (np.std(trial.states[: whole + 1], axis=0) + 1e-12)) ** 2)
    windows = max(1, round(SPAN_S / SECONDS))
    sums = np.convolve(np.minimum(size.sum(axis=1), 100.0), np.ones(windows), mode="valid")
    first = int(found.steps[int(np.argmax(sums)), 0])
    first = max(0, min(first, whole - span))
    return _part(trial, first, first + span), first * trial.dt


def _part(trial: Trial, first: int, last: int) -> Trial:
    held = trial.start_inputs if first == 0 else trial.inputs[first - 1]
    states, inputs = trial.states[first : last + 1], trial.inputs[first:last]
    return replace(trial, states=states, inputs=inputs, start_inputs=held)
