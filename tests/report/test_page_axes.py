"""Axes of the page's panels: what they show, and how their numbers are written."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from test_page import unwrapped

from grounded.diagnosis.error_report import UtilityPrediction
from grounded.diagnosis.pictures import where_figure
from grounded.diagnosis.report import Diagnosis, Ranked, Verdict
from grounded.figures.figure import Curve, log_ticks
from grounded.figures.interactive import in_lines, notebook_figure
from grounded.model import Model
from grounded.result import spread
from grounded.search.pictures import search_figure
from grounded_trials import Workspace
from grounded_trials.report.calmed import WINDOWS, averaged, window_of
from grounded_trials.report.diagnosis_words import utility_sentence
from grounded_trials.report.figures.gap import (
    _binned,
    _telling,
    forecast_figures,
    residual_figures,
)
from grounded_trials.report.figures.png import png
from grounded_trials.report.figures.runs import (
    _timed,
    all_figures,
    bias_figure,
    input_figure,
    state_figure,
)
from grounded_trials.report.findings import Log
from grounded_trials.report.gathering import gather
from grounded_trials.report.page import tables
from grounded_trials.report.page.page import page
from grounded_trials.report.page.tables import forecast_table
from grounded_trials.report.reporting import Report
from grounded_trials.report.scene import reading_order
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import Since
from grounded_trials.workspace.off_target import tracked
from reported import car, cart, copied, many_flights

__all__ = ["car", "cart"]


def test_a_target_that_stays_sets_no_range():
    """The only run of a load that was to hang still: an axis from -1p to 1p, the run cut off."""
    t = np.linspace(0, 1, 11)
    panel = _timed("th", "rad", [Curve(t, 0 * t, "desired"), Curve(t, 0.1 * t - 0.05, "model")])
    assert panel.y_range[0] <= -0.05 and panel.y_range[1] >= 0.05 and not panel.note


def test_a_run_is_not_cut_off_for_little():
    """A first run 1.4 times too large for the axis was cut off."""
    t = np.linspace(0.0, 0.07, 20)
    near, far = (
        _timed("y", "m", [Curve(t, k * t, "model"), Curve(t, 0.02 * t, "best")], spare=50.0)
        for k in (1.4, 9.0)
    )
    assert near.note == "" and near.y_range[1] >= 1.4 * t.max()
    assert far.note and far.y_range[1] < 9.0 * t.max()


def test_every_axis_has_a_name(cart):
    for figure in residual_figures(gather(Folder(cart))):
        assert all(panel.x_name and panel.y_name for panel in figure.panels), figure.name


@pytest.mark.parametrize(("lent", "over"), [(0.0, "a"), (1.0, "b")])
def test_a_residual_is_drawn_over_its_own_input_if_another_only_moves_with_it(lent, over):
    """The missing boom_rate was drawn over stick_valve, with which boom_valve moved."""

    def rates(s, a, p):
        return {"v": a.a - s.v, "w": a.b - s.w}

    units = {"v": "m/s", "w": "m/s"}
    model = Model(states=units, inputs={"a": "1", "b": "1"}, derivative=rates)
    rng = np.random.default_rng(0)
    b = rng.uniform(-1, 1, 400)
    a = b + 0.05 * rng.normal(size=400) + lent * rng.uniform(-1, 1, 400)
    values = np.column_stack([rng.normal(size=(400, 2)), a, b])
    k = _telling(model, 0, values, np.tanh(3 * b))  # b explains it best
    assert [*model.states, *model.inputs][k] == over


def test_the_evidence_says_what_bars_below_zero_mean(cart):
    figure = where_figure(gather(Folder(cart)).diagnosis)
    assert "below 0, it is not worth its parameters" in figure.caption
    assert "Shares are of the squared one-step errors" in figure.caption
    tall = [_rows(one) for one in (figure, replace(figure, caption=""))]
    assert tall[0] > tall[1]  # the picture has the caption, too


def test_a_grey_bar_of_a_tied_effect_is_told_apart_from_those_of_effects_alone():
    """Its evidence is beside the other claimed effects; other grey bars are longer than blue."""
    rows = (("delay:u", 66.0, True), ("first_order_lag:u", 65.0, False), ("gain:u", 300.0, False))
    ranking = tuple(Ranked(name, evidence, claimed=claimed) for name, evidence, claimed in rows)
    verdict, alike = Verdict("effect", effects=("delay:u",)), ("delay:u", "first_order_lag:u")
    tied = Diagnosis(verdict, ranking=ranking, indistinguishable=(alike,))
    caption = where_figure(tied).caption
    assert "first_order_lag:u: beside" in caption and "gain:u:" not in caption
    assert "beside" not in where_figure(replace(tied, indistinguishable=())).caption


def _rows(figure):
    """Return the height of a figure's PNG file in pixels."""
    return int.from_bytes(png(figure)[20:24], "big")


@pytest.mark.parametrize(
    ("std", "text"),
    [(8.8e-4, "0.00088"), (9.06e-5, "0.000091"), (4.4e-6, "0.0000044"), (3e-8, "3.0e-08"),
     (0.02, "0.020"), (0.0, "0")],
)  # fmt: skip
def test_a_small_standard_deviation_has_no_power_of_ten(std, text):
    """It stood beside a value without one: 0.0181 +- 8.8e-04."""
    assert spread(std) == text


def test_powers_of_ten_that_are_too_many_are_left_out():
    """Eleven labels of an axis 240 px high touched each other."""
    ticks = log_ticks(-10.0, 2.5)
    assert len(ticks) <= 7 and ticks[0] < 1e-8 and ticks[-1] >= 1.0
    assert np.allclose(np.diff(np.log10(ticks)), np.log10(ticks[1] / ticks[0]))


def test_charts_begin_with_the_position_and_what_has_a_target(car):
    """A car's charts began with its steering angle, which has no target."""
    findings = gather(Folder(car))
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
    """At 50 Hz, 5 mm of noise was a bias of 0.35 m/s, and both curves of a drone were one block."""
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
    findings = gather(Folder(cart))
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
    """Twelve logs with two models each made 24 columns, most of them off the screen."""
    findings = gather(Folder(cart))
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


@pytest.mark.parametrize(("most", "header"), [(6, ("trial",)), (3, ("trial", "model "))])
def test_errors_of_two_models_stand_side_by_side_if_there_is_room(cart, most, header, monkeypatch):
    monkeypatch.setattr(tables, "MOST_COLUMNS", most)
    model = gather(Folder(cart)).task.model
    errors = [np.array([k, 10.0 * k]) for k in range(1, 5)]
    made = tables._of_trials(("t1", "t2"), ("crude", "better"), errors, model)
    assert made.header[: len(header)] == header
    assert list(made.rows) == (
        [("t1", "1.00", "2.00", "10.0", "20.0"), ("t2", "3.00", "4.00", "30.0", "40.0")]
        if most == 6
        else [("t1", "crude", "1.00", "10.0"), ("t1", "better", "2.00", "20.0"),
              ("t2", "crude", "3.00", "30.0"), ("t2", "better", "4.00", "40.0")]
    )  # fmt: skip


def test_inputs_far_from_their_limits_are_drawn_without_them(cart):
    """A rudder of 0.02 rad was a flat line between limits of 0.8 rad."""
    findings = gather(Folder(cart))
    task = findings.task
    wide = replace(findings, task=replace(task, low=task.low * 0 - 1e3, high=task.high * 0 + 1e3))
    (near,), (far,) = input_figure(findings).panels, input_figure(wide).panels
    assert len(near.rules) == 2 and not near.note
    assert not far.rules and "1000" in far.note
    low, high = far.y_range
    values = np.concatenate([curve.y for curve in far.curves])
    assert high - low < 1.5 * np.ptp(values)


def test_a_diverged_prediction_of_the_utility_has_no_number():
    """7.52e+07 stood where trials differ by 487."""
    found = UtilityPrediction(before=7.52e7, after=12.0, spread=487.0, trials=4, feedback=True)
    text = utility_sentence(Diagnosis(Verdict("effect"), utility_prediction=found))
    assert "e+0" not in text and "over 49,000 (it diverges)" in text


def test_a_line_of_means_does_not_follow_single_points():
    rng = np.random.default_rng(0)
    x = np.concatenate([rng.uniform(0.0, 1.0, 3000), np.linspace(2.0, 4.0, 12)])
    y = np.where(np.arange(len(x)) % 2, 1.0, -1.0)
    at, mean = _binned(x, y)
    assert np.abs(mean[at < 3.5]).max() < 0.5 and at[-1] > 3.5


def test_what_the_diagnosis_adds_is_drawn_for_a_log_without_trials(cart, tmp_path):
    """A workspace of logs showed the crude model's residual, never that of the diagnosis."""
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


@pytest.mark.extra("notebook", "png")
def test_a_note_stands_above_its_panel(cart):
    """It covered the curves in pictures and notebooks."""
    figure = residual_figures(gather(Folder(cart)))[1]
    made = notebook_figure([figure])
    notes = [panel.note for panel in figure.panels]
    assert all(notes) and [a.y >= 1 or a.yref == "paper" for a in made.layout.annotations]
    for note in notes:
        assert sum(note in a.text for a in made.layout.annotations) == notes.count(note)
    assert len(made.layout.annotations) == len(figure.panels)
    assert len(png(figure)) > 10_000


def test_a_standard_error_of_zero_has_no_band(cart):
    """Its legend named a band that had no height."""
    now = gather(Folder(cart)).standing
    best = now.incumbent
    for error, bands in ((0.0, 0), (0.1, 1)):
        one = replace(now, incumbent=replace(best, deviation=error))
        figure = search_figure(one)
        assert len(figure.panels[0].bands) == bands
        assert any(key.shape == "band" for key in figure.key) == bool(bands)


def test_the_command_of_the_next_trial_names_the_workspace(cart):
    """`grounded diagnose --probe` did not work from where the page was made, and broke at `--`."""
    findings = gather(Folder(cart))
    assert findings.diagnosis is not None
    probe = "doublets (`grounded diagnose --probe` makes it)"
    findings = replace(findings, since=Since(), folder="my robot")
    text = page(replace(findings, diagnosis=replace(findings.diagnosis, next_trial=probe)))
    assert "<span>--probe</span>" in text
    assert "grounded -C &#39;my robot&#39; diagnose --probe" in unwrapped(text)


@pytest.mark.extra("notebook")
def test_notebooks_show_words_before_numbers(cart):
    """Status and report were nested lists of raw keys; bars covered their neighbours' labels."""
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
