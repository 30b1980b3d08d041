"""What the page says: once, of the states that the task weighs, and of estimates as estimates."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from cli import grounded
from facts import holds
from grounded.accounts.finding import put_right
from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.report import Diagnosis, Made
from grounded.errors import NextCommand
from grounded_trials.report.diagnosis_notes import note_lines, pattern_line
from grounded_trials.report.figures.gap import forecast_figures
from grounded_trials.report.figures.runs import error_figure, state_figure
from grounded_trials.report.findings import AT_END, ESTIMATED, Log, improvements_in
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.page import page
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import Since
from grounded_trials.workspace.next_step import outlook
from reported import DIAGNOSIS, car, cart
from workspaces import make

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
    """A ball's page drew where the target's speeds would go, and cut the real ones to it."""
    findings = weighed(gather(Folder(car)), x=10.0, y=10.0)
    states, errors = state_figure(findings), error_figure(findings)
    assert states is not None and errors is not None
    desired = {p.title for p in states.panels if any(c.role == "desired" for c in p.curves)}
    assert desired == {"x [m]", "y [m]"} and "v [m/s]" in {p.title for p in states.panels}
    assert not any(p.title.startswith(("v ", "psi ")) for p in errors.panels)
    assert not any(dot.role == "desired" for p in states.panels for dot in p.dots)


def test_of_a_state_that_only_counts_at_the_end_the_end_is_desired(cart):
    findings = weighed(gather(Folder(cart)), x=10.0)
    reward = replace(findings.task.reward, terminal=np.array([0.0, 5.0]))
    states = state_figure(replace(findings, task=replace(findings.task, reward=reward)))
    assert states is not None
    (v,) = (p for p in states.panels if p.title == "v [m/s]")
    assert not any(c.role == "desired" for c in v.curves)
    (dot,) = (d for d in v.dots if d.role == "desired")
    assert dot.y == findings.task.target[-1, 1] and v.y_range[0] < dot.y < v.y_range[1]
    assert dot.note in {key.name for key in states.key}


def test_the_weighed_place_is_told_before_speeds_that_changed(cart):
    """A ball's page gave v and w at the end, and not the ball's place, which was as before."""
    findings = weighed(gather(Folder(cart)), x=10.0, v=1.0)
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
    findings = gather(Folder(cart))
    logs = tuple(
        Log(replace(r.trial, id=f"t010{k}"), r.residual) for k, r in enumerate(findings.runs[:2])
    )
    figures = forecast_figures(replace(findings, logs=logs))
    assert len(figures) == 3
    assert ["Every" in one.caption for one in figures] == [True, False, False]


def test_states_that_no_sensor_gives_are_said_to_be_estimates(cart):
    """The page of the DART bag drew an estimated steering angle as real, half a turn off."""
    findings = gather(Folder(cart))
    assert findings.estimated == () and ESTIMATED not in page(findings)
    findings = replace(findings, estimated=("v",))
    states = state_figure(findings)
    assert states is not None
    for figure in (states, forecast_figures(findings)[0]):
        notes = {p.title: p.note for p in figure.panels}
        assert ESTIMATED in notes["v [m/s]"] and ESTIMATED not in notes["x [m]"]
    assert holds(text_of(findings), "with v as estimated from it", "Not measured: v.")


def test_without_a_trial_nothing_is_offered_to_diagnose(tmp_path):
    """A new workspace's page offered `diagnose`, which refuses to work without a trial."""
    folder = tmp_path / "w"
    make(folder)
    findings = gather(Folder(folder))
    assert text_of(findings).count("Nothing to diagnose yet") == 2
    assert "grounded diagnose" not in text_of(findings)
    told = grounded("-C", folder, "report")
    assert holds(told.out, "nothing to diagnose yet") and "grounded diagnose" not in told.out


def test_how_many_trials_were_diagnosed_is_said_once(cart):
    findings = gather(Folder(cart))
    assert findings.diagnosis is not None
    made = replace(findings.diagnosis, made=Made(trials=("t0001", "t0002")))
    old = replace(findings, diagnosis=made, since=Since(used=2, usable=9, newer=7))
    assert text_of(old).count("Diagnosed with 2 of 9 trials") == 1


def test_an_error_as_small_as_noise_may_have_a_pattern():
    """The page said "down to the noise", and below "pattern"."""
    row = RulerRow(1.0, False, {"x": "m"}, "trials", {"x": 0.02}, with_effects={"x": 0.0049},
                   noise_floor={"x": 0.0045}, floor_from="repeats")  # fmt: skip
    small = Diagnosis.from_json(DIAGNOSIS | {"leftover": [], "prediction_error": []})
    small = replace(small, prediction_error=(row,))
    assert pattern_line(small).startswith("what is left in v is as small as the noise, but has")
    assert ("pattern", pattern_line(small)) in note_lines(small, {})
    assert pattern_line(Diagnosis.from_json(DIAGNOSIS)) == ""  # a gap is left, which is told


def test_why_a_fit_is_next_is_said(cart):
    """A flight's page: `fit`, and below that c0004 is the result."""
    now = gather(Folder(cart)).standing
    then = outlook(now, NextCommand("fit"))
    assert then.startswith(now.sentence) and then.endswith("parameters only, so fit them first")
    assert outlook(now, NextCommand("propose")) == now.sentence


def test_predictions_from_late_sensors_are_told_beside_the_diagnosis(cart):
    """A double pendulum's speeds are 15 ms late: 0.96 rad in a table, 0.48 rad in the verdict."""
    findings = gather(Folder(cart))
    assert "It corrects how late" not in text_of(findings)
    late = put_right("v", "15.20 +- 0.067 ms later", "delay", "delay_s = 0.0152", delay_s=0.0152)
    found = replace(findings, diagnosis=replace(findings.diagnosis, preflight=(late,)))
    assert "It corrects how late v is, and these predictions do not." in text_of(found)
    told = replace(found, effects=("sensor_delay:v",))
    assert "It corrects how late" not in text_of(told)
