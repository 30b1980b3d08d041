"""What the page says: once, of the states that the task weighs, and of estimates as estimates."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from facts import holds
from grounded_trials.report.figures.gap import forecast_figures
from grounded_trials.report.figures.runs import error_figure, state_figure
from grounded_trials.report.findings import AT_END, ESTIMATED, Log, improvements_in
from grounded_trials.report.page.page import page
from reported import car, cart, gathered

__all__ = ["car", "cart"]


def text_of(findings):
    """The page's text, its tags left out."""
    return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", "", page(findings))).replace("\u2060", "")


def weighed(findings, **weights):
    """The findings with other weights on the states along the way, none at the end."""
    names = findings.task.model.state_names
    state = np.array([weights.get(name, 0.0) for name in names])
    reward = replace(findings.task.reward, state=state, terminal=0 * state)
    target = np.nan_to_num(findings.task.target)
    return replace(findings, task=replace(findings.task, reward=reward, target=target))


def test_no_path_is_desired_of_a_state_without_a_weight(car):
    findings = weighed(gathered(car), x=10.0, y=10.0)
    states, errors = state_figure(findings), error_figure(findings)
    assert states is not None and errors is not None
    desired = {p.title for p in states.panels if any(c.role == "desired" for c in p.curves)}
    assert desired == {"x [m]", "y [m]"} and "v [m/s]" in {p.title for p in states.panels}
    assert not any(p.title.startswith(("v ", "psi ")) for p in errors.panels)
    assert not any(dot.role == "desired" for p in states.panels for dot in p.dots)


def test_of_a_state_that_only_counts_at_the_end_the_end_is_desired(cart):
    findings = weighed(gathered(cart), x=10.0)
    reward = replace(findings.task.reward, terminal=np.array([0.0, 5.0]))
    states = state_figure(replace(findings, task=replace(findings.task, reward=reward)))
    assert states is not None
    (v,) = (p for p in states.panels if p.title == "v [m/s]")
    assert not any(c.role == "desired" for c in v.curves)
    (dot,) = (d for d in v.dots if d.role == "desired")
    assert dot.y == findings.task.target[-1, 1] and v.y_range[0] < dot.y < v.y_range[1]
    assert dot.note in {key.name for key in states.key}


def test_the_weighed_place_is_told_before_speeds_that_changed(cart):
    findings = weighed(gathered(cart), x=10.0, v=1.0)
    first, best = findings.first, findings.best
    assert first is not None and best is not None
    states = best.trial.states.copy()
    states[:, 0] = first.trial.states[:, 0]
    runs = tuple(
        replace(r, trial=replace(r.trial, states=states)) if r.candidate is best.candidate else r
        for r in findings.runs
    )
    found = improvements_in(replace(findings, runs=runs))
    told = [one.what.split(",")[0].removeprefix(AT_END) for one in found]
    assert told[0] == "x" and told[-1] == "v" and found[0].is_same and not found[-1].is_same


def test_what_a_forecast_is_stands_above_the_first_alone(cart):
    findings = gathered(cart)
    logs = tuple(
        Log(replace(r.trial, id=f"t010{k}"), r.residual) for k, r in enumerate(findings.runs[:2])
    )
    figures = forecast_figures(replace(findings, logs=logs))
    assert len(figures) == 3
    assert ["Every" in one.caption for one in figures] == [True, False, False]


def test_states_that_no_sensor_gives_are_said_to_be_estimates(cart):
    findings = gathered(cart)
    assert findings.estimated == () and ESTIMATED not in page(findings)
    findings = replace(findings, estimated=("v",))
    states = state_figure(findings)
    assert states is not None
    for figure in (states, forecast_figures(findings)[0]):
        notes = {p.title: p.note for p in figure.panels}
        assert ESTIMATED in notes["v [m/s]"] and ESTIMATED not in notes["x [m]"]
    assert holds(text_of(findings), "with v as estimated from it", "Not measured: v.")
