"""Forecasts: rollouts of a model along a trial, restarted from the measured state periodically.

They show the gap between model and reality: from a measured state, with the inputs that were sent,
where does the model predict the robot a second later? All rollouts are simulated at once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.diagnosis.error_report import furthest
from grounded.figures import Figure, calm_range, curve, panel
from grounded.frozen import Array
from grounded.places import true_values
from grounded.rollout import augmented
from grounded.search.planner import Planner
from grounded.solve.bias import residuals
from grounded.trial import Trial
from grounded_trials.report.bodies import reading_order
from grounded_trials.report.findings import ESTIMATED, Findings, Log, Run
from grounded_trials.wording import labelled, shown

SECONDS = 1.0  # of a forecast, if the diagnosis has no shorter horizon
SPAN_S = 30.0  # [s] of a long log that are drawn, where the errors are largest
LOGS = 2  # number of logs drawn; the table has all
RESTARTED = "Predictions restarted every"


def forecast(planner: Planner, trial: Trial, seconds: float = SECONDS) -> tuple[Array, Array]:
    """Forecast a trial with the planner's model, restarted every `seconds`.

    Args:
        planner: planner of the crude model, or of one with effects.
        trial: the trial, of which the finite part is used: a complete step or more.
        seconds: length of a rollout [s]; each starts where the last one ends.

    Returns:
        Times (K,) [s] and states (K, n), with a row of NaN after each rollout.
    """
    whole, n, plan = trial.finite_steps, planner.task.model.n, planner.plan
    part = trial.until(whole)
    lifted, problem = anchored(planner, part), plan.problem(exact=True)
    past = plan.past if part.start_inputs is None else part.start_inputs
    z = augmented(problem, lifted.states, lifted.inputs, past)
    received = problem.queue.effective(z[:-1], lifted.inputs)
    length = max(1, min(round(seconds / trial.dt), whole))
    starts = np.arange(0, whole, length)
    x = lifted.states[starts]
    states = np.full((len(starts), length + 2, n), np.nan)
    states[:, 0] = x[:, :n]
    with np.errstate(all="ignore"):
        for k in range(length):
            at, inside = np.minimum(starts + k, whole - 1), starts + k < whole
            x = problem.system.step(x, received[at], problem.p, problem.dt)
            states[inside, k + 1] = x[inside, :n]
    steps = np.minimum(starts[:, None] + np.minimum(np.arange(length + 2), length), whole)
    return steps.reshape(-1) * trial.dt, states.reshape(-1, n)


def anchored(planner: Planner, trial: Trial) -> Trial:
    """Extend a finite trial by the planning model's memory states, without their drift.

    The true value of a state that is logged late or with a lag follows from the model alone, and
    drifts. The model's residual of that state is the drift, and is added to the memory.
    """
    lifted, n = planner.lift(trial), planner.task.model.n
    names = planner.plan.model.state_names
    behind = true_values(names, names[n:])
    if not behind:
        return lifted
    drift, states = residuals(planner.plan, lifted), np.array(lifted.states)
    states[1:, list(behind)] += drift[:, list(behind.values())]
    return replace(lifted, states=states)


# its figures


def forecast_figures(findings: Findings) -> list[Figure]:
    """Return forecasts of a run unknown to the diagnosis, else of the best; and of long logs."""
    drawn, ahead = list[tuple[str, str, Run | Log]](), _ahead_s(findings)
    if (run := forecast_run(findings)) is not None:
        drawn = [("forecast", run.label, run)]
    longest = sorted(findings.logs, key=lambda log: -log.trial.finite_steps)[:LOGS]
    drawn += [(f"data-{log.trial.id}", f"data {log.trial.id}", log) for log in longest]
    return [
        _figure(findings, name, f"{RESTARTED} {ahead:.3g} s, {of}", one, ahead)
        for name, of, one in drawn
        if one.trial.finite_steps > 0
    ]


def forecast_run(findings: Findings) -> Run | None:
    """Return the latest run that the diagnosis did not use, else the latest of the best one."""
    made = findings.diagnosis.made if findings.diagnosis is not None else None
    fresh = [r for r in findings.runs if made is not None and r.trial.id not in made.trials]
    if fresh or findings.best is None:
        return next(reversed(fresh or findings.runs), None)
    return findings.best


def _ahead_s(findings: Findings) -> float:
    """Return a second, or less if the diagnosis predicts less far, as for unstable systems."""
    row = furthest(() if findings.diagnosis is None else findings.diagnosis.prediction_error)
    return SECONDS if row is None else min(SECONDS, row.horizon_s)


def _figure(findings: Findings, name: str, title: str, of: Run | Log, ahead_s: float) -> Figure:
    trial, begin = _worst_part(of)
    task = findings.task
    changed = any(task.model.params[n].value != value for n, value in findings.nominal.items())
    own = f"{'present' if changed else 'crude'} model" + ", without effects" * bool(
        findings.effects
    )
    models = [("model", own, forecast(Planner(task, task), trial, ahead_s))]
    if (better := findings.better) is not None:
        models.append(("best", f"model {better.name}", forecast(better.planner, trial, ahead_s)))

    # a panel for each state
    times = np.arange(trial.steps + 1, dtype=np.float64) * trial.dt + begin
    panels = []
    for i in reading_order(task):
        state, unit = list(task.model.states.items())[i]
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
