"""What the page's panels, tables and lists hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from grounded_trials.report.figures.gap import forecast_figures
from grounded_trials.report.figures.runs import error_figure, state_figure
from grounded_trials.report.findings import ESTIMATED
from grounded_trials.report.page import page
from reported import car, cart, gathered

__all__ = ["car", "cart"]


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
    desired = {
        p.title for p in states.panels if any(c["meta"]["role"] == "desired" for c in p.curves)
    }
    assert desired == {"x [m]", "y [m]"} and "v [m/s]" in {p.title for p in states.panels}
    assert not any(p.title.startswith(("v ", "psi ")) for p in errors.panels)
    assert not any("desired at" in str(t.get("text")) for p in states.panels for t in p.data)


def test_states_that_no_sensor_gives_are_said_to_be_estimates(cart):
    findings = gathered(cart)
    assert findings.estimated == () and ESTIMATED not in page(findings)
    findings = replace(findings, estimated=("v",))
    states = state_figure(findings)
    assert states is not None
    for figure in (states, forecast_figures(findings)[0]):
        notes = {p.title: p.note for p in figure.panels}
        assert ESTIMATED in notes["v [m/s]"] and ESTIMATED not in notes["x [m]"]
