"""Figures of the gap between model and reality: forecasts, restarted from the measured state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.figures import Figure, calm_range, curve, panel
from grounded.trial import Trial
from grounded_trials.report.bodies import reading_order
from grounded_trials.report.findings import ESTIMATED, Findings, Log, Run
from grounded_trials.report.forecast import forecast
from grounded_trials.wording import labelled, shown

SPAN_S = 30.0  # [s] of a long log that are drawn, where the errors are largest
LOGS = 2  # number of logs drawn; the table has all
RESTARTED = "Predictions restarted every"


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
