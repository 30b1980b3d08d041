"""Axes of the page's panels: what they show, and how their numbers are written."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from grounded.figures.figure import log_ticks
from grounded.figures.interactive import in_lines
from grounded.result import spread
from grounded_trials import Workspace
from grounded_trials.report.calmed import WINDOWS, averaged, window_of
from grounded_trials.report.figures.gap import (
    forecast_figures,
    residual_figures,
)
from grounded_trials.report.figures.runs import (
    all_figures,
    bias_figure,
    state_figure,
)
from grounded_trials.report.findings import Log
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.tables import forecast_table
from grounded_trials.report.reporting import Report
from grounded_trials.report.scene import reading_order
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.off_target import tracked
from reported import car, cart, copied, gathered, many_flights

__all__ = ["car", "cart"]


def test_every_axis_has_a_name(cart):
    for figure in residual_figures(gathered(cart)):
        assert all(panel.x_name and panel.y_name for panel in figure.panels), figure.name


@pytest.mark.parametrize(
    ("std", "text"),
    [(8.8e-4, "0.00088"), (9.06e-5, "0.000091"), (4.4e-6, "0.0000044"), (3e-8, "3.0e-08"),
     (0.02, "0.020"), (0.0, "0")],
)  # fmt: skip
def test_a_small_standard_deviation_has_no_power_of_ten(std, text):
    assert spread(std) == text


def test_powers_of_ten_that_are_too_many_are_left_out():
    ticks = log_ticks(-10.0, 2.5)
    assert len(ticks) <= 7 and ticks[0] < 1e-8 and ticks[-1] >= 1.0
    assert np.allclose(np.diff(np.log10(ticks)), np.log10(ticks[1] / ticks[0]))


def test_charts_begin_with_the_position_and_what_has_a_target(car):
    findings = gathered(car)
    task, names = findings.task, findings.task.model.state_names
    order = [names[i] for i in reading_order(task)]
    wanted = [names[i] for i in tracked(task)]
    assert sorted(order) == sorted(names) and order[:2] == ["x", "y"]
    assert set(order[: len(wanted)]) == set(wanted) and list(names[:2]) != order[:2]
    for figure in (state_figure(findings), bias_figure(findings), *forecast_figures(findings)):
        assert [panel.title.split(" [")[0] for panel in figure.panels] == order, figure.name
    drawn = [figure.name for figure in all_figures(findings)]
    assert drawn.index("states") < drawn.index("inputs") < drawn.index("error")


def test_a_bias_hidden_by_noise_is_drawn_as_means_over_time():
    findings = many_flights(1)
    (run,), dt = findings.runs, findings.task.dt
    steps, n = run.residual.shape
    noise = np.random.default_rng(0).normal(0, 0.005, (steps + 1, n))
    course = 0.1 * dt * np.sin(np.linspace(0, 7, steps))[:, None]
    noisy = replace(run, residual=course + np.diff(noise, axis=0))
    figure, window = bias_figure(replace(findings, runs=(noisy,))), -(-steps // WINDOWS)
    for panel in figure.panels:
        (curve,) = panel.curves
        np.testing.assert_allclose(np.diff(curve.x), window * dt)
        assert curve.x[0] == pytest.approx(0.5 * (window - 1) * dt) and panel.note
        drawn = np.interp(curve.x, dt * np.arange(steps), course[:, 0] / dt)
        assert np.abs(curve.y - drawn).max() < 0.05 < np.ptp(noise) / dt


def test_a_calm_bias_is_drawn_step_by_step(cart):
    findings = gathered(cart)
    for panel in bias_figure(findings).panels:
        assert len(panel.curves[0].x) == len(findings.improvements[0].residual) and not panel.note
    steady = np.full(300, 2.0) + np.random.default_rng(0).normal(0, 0.5, 300)
    noise = np.random.default_rng(0).normal(0, 0.5, 300)
    slow = np.sin(np.linspace(0, 20, 300))
    assert window_of([steady]) == window_of([slow, 0.2 * noise]) == 1 < window_of([noise])
    assert window_of([noise[:100]]) == window_of([np.full(300, np.nan)]) == window_of([]) == 1
    np.testing.assert_allclose(averaged(np.arange(7.0), 3), [1.0, 4.0])


@pytest.mark.parametrize(("logs", "states_first"), [(1, True), (24, False)])
def test_many_logs_are_rows_of_the_table_of_forecasts(cart, logs, states_first):
    findings = gathered(cart)
    trial = findings.runs[0].trial
    data = tuple(
        Log(replace(trial, id=f"d{k:02d}"), findings.runs[0].residual) for k in range(logs)
    )
    few = replace(findings, runs=(), logs=data, better=None)
    _, made, *_ = forecast_table(few)
    states = findings.task.model.states
    assert len(made.header) == (2 + logs if states_first else 1 + len(states))
    assert len(made.rows) == (len(states) if states_first else logs)
    assert all(len(row) == len(made.header) for row in made.rows)
    _, single, *_ = forecast_table(replace(few, logs=data[:1]))
    of_first = [row[2] for row in single.rows]
    assert of_first == ([row[2] for row in made.rows] if states_first else list(made.rows[0][1:]))


def test_what_the_diagnosis_adds_is_drawn_for_a_log_without_trials(cart, tmp_path):
    w = Workspace(copied(cart, tmp_path / "cart"))
    data = replace(w.trials()[-1].trial, candidate="")
    for k, name in enumerate(("a", "b")):
        one = replace(data, states=data.states + 0.01 * k)
        write_trial(w.folder / f"{name}.mcap", one, {"kind": "data"})
        w.ingest(w.folder / f"{name}.mcap", data=True)
    findings = gather(w)
    assert [log.explained is not None for log in findings.logs] == [False, True]
    over, rest = residual_figures(replace(findings, runs=()))
    for figure in (over, rest):
        assert all([c.role for c in panel.curves] == ["model", "best"] for panel in figure.panels)


@pytest.mark.extra("notebook")
def test_notebooks_show_words_before_numbers(cart):
    w = Workspace(cart)
    status, report = w.status(), Report(gather(w), ())
    for found in (status, report):
        text = re.sub("<details>.*?</details>", "", found._repr_html_(), flags=re.DOTALL)
        assert "<table>" in text and "next: <code>grounded" in text
        assert "predicted_utility" not in text and "standard_error" not in text
    assert "nan" not in report._repr_html_()
    drawn = report.findings.diagnosis.plot()
    left, right = drawn.layout.xaxis.domain, drawn.layout.xaxis2.domain
    bars = [panel for f in report.findings.diagnosis.figures() for panel in f.panels][1::2]
    labels = [bar.label for panel in bars if hasattr(panel, "bars") for bar in panel.bars]
    longest = max(len(line) for label in labels for line in in_lines(label).split("<br>"))
    assert right[0] - left[1] == pytest.approx(min(0.4, max(0.12, 0.008 * longest)))
    names = [trace.name for trace in status.plot().data if trace.showlegend is not False]
    assert {"no better", "predicted by the model", "best so far"} <= set(names)
    assert len(names) == len(set(names))
