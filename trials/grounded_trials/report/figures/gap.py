"""Figures of the gap between model and reality: forecasts and residuals.

Forecasts restart the model from the measured state every second. Residuals are drawn over the
variable that explains most of them, with the contribution of the diagnosed model as a line.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from grounded.figures.figure import Figure, Panel, calm_range, curve, fitted, panel
from grounded.frozen import Array
from grounded.trial import Trial
from grounded_trials.report.bodies import reading_order
from grounded_trials.report.findings import ESTIMATED, Findings, Log, Run
from grounded_trials.report.forecast import forecast
from grounded_trials.wording import labelled, per_second, shown

SPAN_S = 30.0  # [s] of a long log that are drawn, where the errors are largest
LOGS = 2  # number of logs drawn; the table has all
CHANNELS = 4  # number of states whose residuals are drawn
BINS = 24
RESTARTED = "Predictions restarted every"
LEAST_STEPS = 30  # shortest trial whose residual is drawn


def forecast_figures(findings: Findings) -> list[Figure]:
    """Return forecasts of a run unknown to the diagnosis, else of the best; and of long logs."""
    drawn: list[tuple[str, str, Run | Log]] = []
    if (run := forecast_run(findings)) is not None:
        drawn = [("forecast", run.label, run)]
    longest = sorted(findings.logs, key=lambda log: -log.trial.finite_steps)[:LOGS]
    drawn += [(f"data-{log.trial.id}", f"data {log.trial.id}", log) for log in longest]
    return [
        _figure(findings, name, f"{RESTARTED} {findings.ahead_s:.3g} s, {of}", one)
        for name, of, one in drawn
        if one.trial.finite_steps > 0
    ]


def forecast_run(findings: Findings) -> Run | None:
    """Return the latest run that the diagnosis did not use, else the latest of the best one."""
    made = findings.diagnosis.made if findings.diagnosis is not None else None
    fresh = [r for r in findings.runs if made is not None and r.trial.id not in made.trials]
    return fresh[-1] if fresh else findings.lately


def _figure(findings: Findings, name: str, title: str, of: Run | Log) -> Figure:
    trial, begin = _worst_part(of)
    models = [("model", findings.plain, forecast(findings.crude, trial, findings.ahead_s))]
    if (better := findings.better) is not None:
        ahead = forecast(better.planner, trial, findings.ahead_s)
        models.append(("best", f"model {better.name}", ahead))

    # a panel for each state
    times = np.arange(trial.steps + 1, dtype=np.float64) * trial.dt + begin
    panels = []
    for i in reading_order(findings.task):
        state, unit = list(findings.task.model.states.items())[i]
        real = curve(times, trial.states[:, i], "real", "real")
        made = [curve(t + begin, x[:, i], role, words, 1.2) for role, words, (t, x) in models]
        panels.append(
            panel(
                labelled(state, unit),
                "time [s]",
                shown(unit),
                [real, *made],
                y_range=calm_range([real["y"]], [one["y"] for one in made]),
                note=ESTIMATED * (state in findings.estimated),
                kind="forecast",
            )
        )

    # what of which trial is drawn
    said, used = [], findings.diagnosis.made if findings.diagnosis is not None else None
    if used is not None and better is not None and trial.id not in used.trials:
        said.append("held out")
    if trial.steps < of.trial.finite_steps:
        said.append(f"{begin:.4g} to {begin + trial.steps * trial.dt:.4g} s")
    return Figure(name, title, ", ".join(said), panels)


def _worst_part(of: Run | Log) -> tuple[Trial, float]:
    """Return the SPAN_S of a long trial with the largest residuals, and its start [s]."""
    trial, whole = of.trial, of.trial.finite_steps
    span, first = min(round(SPAN_S / trial.dt), whole), 0
    if span < whole:
        spread = np.std(trial.states[: whole + 1], axis=0) + 1e-12
        size = np.cumsum(np.sum((of.residual[:whole] / spread) ** 2, axis=1))
        first = int(np.argmax(size[span:] - size[:-span])) + 1
    held = trial.start_inputs if first == 0 else trial.inputs[first - 1]
    states, inputs = trial.states[first : first + span + 1], trial.inputs[first : first + span]
    return replace(trial, states=states, inputs=inputs, start_inputs=held), first * trial.dt


def residual_figures(findings: Findings) -> list[Figure]:
    """Return the figure of the residual of the best candidate's latest run, else the last log."""
    latest: Run | Log | None = findings.lately or (findings.logs or (None,))[-1]
    if latest is None or latest.trial.finite_steps < LEAST_STEPS:
        return []
    channels = _channels(findings, latest)
    panels = [_over(findings, latest, state) for state in channels]
    title, of = "What the model lacks", latest.trial.id or "best"
    return [Figure("residual", title, of, panels)]


def _channels(findings: Findings, latest: Run | Log) -> list[int]:
    """Return the states that the diagnosis blames, then those with the largest residuals."""
    names, diagnosis = findings.task.model.state_names, findings.diagnosis
    whole = latest.trial.finite_steps
    states, residual = latest.trial.states[:whole], latest.residual[:whole]
    found = diagnosis.where.channels if diagnosis is not None else ()
    blamed = [c.name for c in found if c.share > 0]
    known = [names.index(name) for name in blamed if name in names]
    spread = np.std(states, axis=0) + 1e-9
    sizes = np.where(np.ptp(residual, axis=0) > 0, np.std(residual, axis=0) / spread, -1.0)
    rest = [int(i) for i in np.argsort(-sizes) if sizes[i] >= 0 and i not in known]
    return [*known, *rest][:CHANNELS]


def _over(findings: Findings, latest: Run | Log, state: int) -> Panel:
    """Draw a state's residual over the state or input that explains most of its variance."""
    model, trial, better = findings.task.model, latest.trial, findings.better
    steps, units = trial.finite_steps, [*model.states.items(), *model.inputs.items()]
    values = np.hstack([trial.states[:steps], trial.inputs[:steps]])
    rate = latest.residual[:steps, state] / trial.dt
    k = int(np.argmax([_explained(column, rate) for column in values.T]))
    x = values[:, k]
    curves = [curve(x, rate, "model", findings.plain, style="points")]
    if latest.explained is not None and better is not None:
        added = rate - latest.explained[:steps, state] / trial.dt
        at, mean = (_means(v, _bins(x)) for v in (x, added))
        curves.append(curve(at, mean, "best", f"model {better.name}", 2.5))
    name, unit = list(model.states.items())[state]
    return panel(
        f"{name}: what the model lacks, over {units[k][0]}",
        labelled(*units[k]),
        labelled(f"missing {name}", per_second(unit)),
        curves,
        y_range=fitted([np.quantile(rate, [0.002, 0.998])], 0.15),
    )


def _bins(x: Array) -> NDArray[np.intp]:
    """Return the bin of each value, in bins that are about equally full; equal values share one."""
    edges = np.quantile(x, np.linspace(0, 1, min(BINS, max(2, len(x) // 8)) + 1)[1:])
    return np.unique(np.searchsorted(np.unique(edges), x), return_inverse=True)[1]


def _means(values: Array, bins: NDArray[np.intp]) -> Array:
    return np.bincount(bins, values) / np.bincount(bins)


def _explained(x: Array, y: Array) -> float:
    """Return the share of y's variance that is explained by its means in bins of x."""
    total, bins = float(np.var(y)), _bins(x)
    return float(np.var(_means(y, bins)[bins])) / total if total > 0 else 0.0
