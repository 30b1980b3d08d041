"""Figures of the gap between model and reality: forecasts, residuals, autocorrelation.

Forecasts restart the model from the measured state every second. Residuals are drawn over the
variable that explains most of them, with the contribution of the diagnosed model as a line. The
autocorrelation shows whether the remaining residual is noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded.figures.figure import Band, Curve, Figure, Key, Panel, fitted, legend, without_astray
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import INSTANT_S, probe, samples
from grounded.trial import Trial
from grounded_trials.report.bodies import reading_order
from grounded_trials.report.findings import ESTIMATED, Findings, Run
from grounded_trials.report.forecast import forecast
from grounded_trials.wording import labelled, per_second, percent, shown

SPAN_S = 30.0  # [s] of a long log that are drawn, where the errors are largest
LOGS = 2  # number of logs drawn; the table has all
CHANNELS = 4  # number of states whose residuals are drawn
POINTS = 1500  # points of a residual
BINS = 24
NEARLY = 0.05  # of a residual's variance: what another variable may explain more, by chance
RESTARTED = "Predictions restarted every"
LAGS_S, LAGS = 1.0, 60  # largest lag of the autocorrelation, in [s] and in steps
LEAST_STEPS = 30  # shortest trial whose residual is drawn


def forecast_figures(findings: Findings) -> list[Figure]:
    """Return forecasts of a run unknown to the diagnosis, else of the best; and of long logs."""
    found, ahead = [], f"{findings.ahead_s:.3g} s"
    run = forecast_run(findings)
    if run is not None:
        title = f"{RESTARTED} {ahead}, {run.label}"
        found.append(_figure(findings, "forecast", title, run.trial))
    longest = sorted(findings.logs, key=lambda log: -log.trial.finite_steps)[:LOGS]
    for log in longest:
        title = f"{RESTARTED} {ahead}, data {log.trial.id}"
        found.append(_figure(findings, f"data-{log.trial.id}", title, log.trial))
    some = [figure for figure in found if figure is not None]
    return some


def forecast_run(findings: Findings) -> Run | None:
    """Return the latest run that the diagnosis did not use, else the latest of the best one."""
    made = findings.diagnosis.made if findings.diagnosis is not None else None
    seen = set(made.trials) if made is not None else None
    fresh = [r for r in findings.runs if seen is not None and r.trial.id not in seen]
    return fresh[-1] if fresh else findings.lately


def _figure(findings: Findings, name: str, title: str, trial: Trial) -> Figure | None:
    steps = trial.finite_steps
    if steps < 1:
        return None
    trial, begin = _worst_part(findings, trial)
    crude = forecast(findings.crude, trial, findings.ahead_s)
    if crude is None:
        return None
    better = findings.better
    after = forecast(better.planner, trial, findings.ahead_s) if better is not None else None
    times = np.arange(trial.steps + 1, dtype=np.float64) * trial.dt + begin
    panels = []
    for i in reading_order(findings.task):
        state, unit = list(findings.task.model.states.items())[i]
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
        y_name = shown(unit)
        note = ESTIMATED * (state in findings.estimated)
        panels.append(
            Panel(
                label, "time [s]", y_name, tuple(curves), y_range=bounds, note=note, kind="forecast"
            )
        )
    said, diagnosis = [], findings.diagnosis
    if diagnosis is not None and diagnosis.made is not None and better is not None:
        said.append("held out" * (trial.id not in diagnosis.made.trials))
    if trial.steps < steps:
        end = begin + trial.steps * trial.dt
        said.append(f"{begin:.4g} to {end:.4g} s")
    return Figure(name, title, ", ".join(filter(None, said)), tuple(panels), legend(panels))


def _worst_part(findings: Findings, trial: Trial) -> tuple[Trial, float]:
    """Return the SPAN_S of a long trial with the largest forecast errors, and its start [s]."""
    whole = trial.finite_steps
    span = round(SPAN_S / trial.dt)
    if whole <= span:
        return _part(trial, 0, whole), 0.0
    found = forecast(findings.crude, trial, findings.ahead_s)
    assert found is not None
    kept = found.steps[:, -1] >= 0
    ends = found.steps[kept, -1]
    off = findings.task.model.difference(found.states[kept, -1], trial.states[ends])
    size = np.nan_to_num((off / (np.std(trial.states[: whole + 1], axis=0) + 1e-12)) ** 2)
    windows = max(1, round(SPAN_S / findings.ahead_s))
    sums = np.convolve(np.minimum(size.sum(axis=1), 100.0), np.ones(windows), mode="valid")
    first = int(found.steps[int(np.argmax(sums)), 0])
    first = max(0, min(first, whole - span))
    return _part(trial, first, first + span), first * trial.dt


def _part(trial: Trial, first: int, last: int) -> Trial:
    held = trial.start_inputs if first == 0 else trial.inputs[first - 1]
    states, inputs = trial.states[first : last + 1], trial.inputs[first:last]
    return replace(trial, states=states, inputs=inputs, start_inputs=held)


def residual_figures(findings: Findings) -> list[Figure]:
    """Return the figures of the residual and of its autocorrelation."""
    run = findings.lately
    data: list[tuple[Trial, Array, Array | None]] = [
        (one.trial, one.residual, one.explained)
        for one in ([run] if run is not None else findings.logs[-1:])
    ]
    if not data or data[0][0].finite_steps < LEAST_STEPS:
        return []
    trial, residual, explained = data[0]
    whole = trial.finite_steps
    explained = None if explained is None else explained[:whole]
    channels = _channels(findings, trial.states[:whole], residual[:whole])
    over = [_over(findings, trial, i, residual[:whole], explained) for i in channels]
    rest = [_autocorrelation(findings, trial, i, residual[:whole], explained) for i in channels]
    name = trial.id or "best"
    return [
        Figure("residual", "What the model lacks", name, tuple(over), legend(over)),
        Figure(
            "autocorrelation", "Autocorrelation of the residual", name, tuple(rest),
            (*legend(rest), Key("other", "white noise, 95 %", "band")),
        ),
    ]  # fmt: skip


def _channels(findings: Findings, states: Array, residual: Array) -> list[int]:
    """Return the states that the diagnosis blames, then those with the largest residuals."""
    names, diagnosis = findings.task.model.state_names, findings.diagnosis
    found = diagnosis.where.channels if diagnosis is not None else ()
    blamed = [c.name for c in found if c.share > 0]
    known = [names.index(name) for name in blamed if name in names]
    spread = np.std(states, axis=0) + 1e-9
    sizes = np.where(np.ptp(residual, axis=0) > 0, np.std(residual, axis=0) / spread, -1.0)
    rest = [int(i) for i in np.argsort(-sizes) if sizes[i] >= 0 and i not in known]
    return [*known, *rest][:CHANNELS]


def _over(
    findings: Findings, trial: Trial, state: int, residual: Array, explained: Array | None
) -> Panel:
    """Draw a state's residual over the state or input that explains it, see `_telling`."""
    model, steps = findings.task.model, len(residual)
    units = [*model.states.items(), *model.inputs.items()]
    values = np.hstack([trial.states[:steps], trial.inputs[:steps]])
    rate = residual[:, state] / trial.dt
    k = _telling(model, state, values, rate)
    x = values[:, k]
    some = np.linspace(0, steps - 1, min(steps, POINTS)).astype(int)
    curves = [Curve(x[some], rate[some], "model", findings.plain, style="points")]
    better = findings.better
    if explained is not None and better is not None:
        added = rate - explained[:, state] / trial.dt
        at, mean = _binned(x, added)
        curves.append(Curve(at, mean, "best", f"model {better.name}", 2.5))
    name, unit = list(model.states.items())[state]
    title = f"{name}: what the model lacks, over {units[k][0]}"
    bounds = fitted([np.quantile(rate, [0.002, 0.998])], 0.15)
    return Panel(
        title, labelled(*units[k]), labelled(f"missing {name}", per_second(unit)), tuple(curves),
        y_range=bounds,
    )  # fmt: skip


def _telling(model: Model, state: int, values: Array, rate: Array) -> int:
    """Return the column of states and inputs that explains most of a residual's variance.

    If what the state's rate depends on in the model explains nearly as much, that is preferred:
    inputs may merely move together.
    """
    telling = [_told(column, rate) for column in values.T]
    best = max(_own(model, state), key=telling.__getitem__)
    return best if telling[best] > max(telling) - NEARLY else int(np.argmax(telling))


def _own(model: Model, state: int) -> list[int]:
    """Return the columns (states, then inputs) on which a state's rate depends, and its own."""
    dt, (x, u) = probe(model, INSTANT_S), samples(model, 8)
    by_states, by_inputs = model.system.linearise(x, u, model.values, dt)[:2]
    by_states = by_states - np.eye(model.n)
    sizes = np.abs(np.concatenate([by_states[:, state], by_inputs[:, state]], axis=-1)).max(axis=0)
    return [k for k, size in enumerate(sizes) if k == state or size > 1e-3 * dt]


def _bins(x: Array) -> int:
    return min(BINS, max(2, len(x) // 8))


def _edges(x: Array) -> Array:
    return np.unique(np.quantile(x, np.linspace(0, 1, _bins(x) + 1)))


def _told(x: Array, y: Array) -> float:
    """Return the share of y's variance that is explained by its means in bins of x."""
    edges, total = _edges(x), float(np.var(y))
    if len(edges) < 3 or not total > 0:
        return 0.0
    which = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(which, minlength=len(edges) - 1)
    means = np.bincount(which, y, len(edges) - 1) / np.maximum(counts, 1)
    return float(np.sum(counts * (means - y.mean()) ** 2) / (len(y) * total))


def _binned(x: Array, y: Array) -> tuple[Array, Array]:
    """Return means of x and y in equally full bins of x."""
    parts = np.array_split(np.argsort(x), _bins(x))
    return np.array([x[p].mean() for p in parts]), np.array([y[p].mean() for p in parts])


def _autocorrelation(
    findings: Findings, trial: Trial, state: int, residual: Array, explained: Array | None
) -> Panel:
    """Draw the autocorrelation of a state's residual, without and with the diagnosed effects."""
    most = min(LAGS, len(residual) // 3, max(5, round(LAGS_S / trial.dt)))
    lags = range(1, most + 1)
    shown_ = [(residual, "model", findings.plain)]
    if explained is not None and findings.better is not None:
        shown_.append((explained, "best", f"model {findings.better.name}"))
    curves, note = [], ""
    if explained is not None:
        left = float(np.std(explained[:, state]) / (np.std(residual[:, state]) or 1.0))
        note = f"{percent(left)} left"
    note += "; " * bool(note) + "sensor noise alone: −0.5 at the first lag"
    for values, role, name in shown_:
        y = values[:, state] - values[:, state].mean()
        power = float(y @ y) or 1.0
        found = np.array([float(y[lag:] @ y[:-lag]) / power for lag in lags])
        curves.append(Curve(np.array(lags) * float(trial.dt), found, role, name, 2.0))
    bound = 1.96 / np.sqrt(len(residual))
    band = Band(-bound, bound, "other", "white noise, 95 %")
    name = findings.task.model.state_names[state]
    return Panel(
        name, "lag [s]", "correlation", tuple(curves),
        bands=(band,), y_range=(-1.05, 1.05), note=note,
    )  # fmt: skip
