"""Figures: thinning that moves nothing, round ticks, and pictures that hold what they should."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from grounded.diagnosis.error_report import Credit, RulerRow
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.diagnosis.telling import accuracy_figure, credit_figure
from grounded.experiments.pendulum import pendulum_task
from grounded.figures.figure import Figure, curve, log_ticks, marks, panel, rule
from grounded.model import Model
from grounded.models import pendulum
from grounded.rollout import simulate
from grounded.search.first_policy import first_policy
from grounded.search.pictures import few
from grounded.search.planner import Planner
from grounded.trial import Trial
from grounded_trials.report.bodies import scene_of
from grounded_trials.report.figures.png import png
from grounded_trials.report.figures.runs import all_figures
from grounded_trials.report.forecast import forecast
from reported import gathered, many_flights

FIGURES = ("utility", "paths", "states", "inputs", "error", "bias")
FIGURES += ("forecast", "residual")


@pytest.mark.slow
@pytest.mark.extra("png")
def test_pictures_are_drawn_in_their_colours(cart):
    from PIL import Image

    figures = all_figures(gathered(cart))
    assert tuple(f.name for f in figures) == FIGURES
    for figure in figures[:3]:
        image = Image.open(io.BytesIO(png(figure)))
        assert image.width >= 900 and image.height >= 300
        colours = {colour for _, colour in image.convert("RGB").getcolors(1 << 24) or ()}
        assert (0, 114, 178) in colours, figure.name


@pytest.mark.parametrize(
    ("roles", "axes"),
    [
        ({"position": ("x",), "speed": "v"}, ("x", "v")),
        ({"position": "x", "speed": "v"}, ("x", "v")),
        ({"position": ("v",)}, ("v", "theta")),
        ({}, ("theta", "x")),
    ],
)
def test_a_position_along_one_axis_is_drawn_over_its_speed(roles, axes):
    model = Model(
        states={"theta": "rad", "x": "m", "v": "m/s"},
        inputs={"force": "N"},
        roles=roles,
        derivative=lambda s, a, p: {"theta": s.v, "x": s.v, "v": a.force},
    )
    scene = scene_of(model)
    assert scene.names == axes and not scene.spatial


@pytest.fixture(scope="module")
def swung():
    """A pendulum's task and a run of the model itself."""
    task = pendulum_task(pendulum.model)
    policy, _ = first_policy(task)
    made = simulate(task.problem(exact=True), policy)
    names = (task.model.state_names, task.model.input_names)
    return task, Trial(made.states, made.inputs, task.dt, *names, start_inputs=task.past)


def _missed(task, model, trial, seconds):
    """The largest error of forecasts of a trial, by state."""
    task = task.with_model(model)
    times, states = forecast(Planner(task, task), trial, seconds)
    at = np.rint(times / task.dt).astype(int)
    assert np.isnan(states).any(axis=1).sum() >= trial.steps * task.dt / seconds
    return np.nanmax(np.abs(states - trial.states[at]), axis=0)


def test_a_forecast_with_the_true_model_stays_on_the_trial_and_others_part_from_it(swung):
    task, trial = swung
    assert _missed(task, task.model, trial, 0.5).max() < 1e-9
    wrong = task.model.with_values({"m": 1.3})
    short, long = (_missed(task, wrong, trial, seconds)[0] for seconds in (0.1, 1.0))
    assert 1e-6 < short < long
    cut = replace(trial, states=np.vstack([trial.states[:8], trial.states[8:] * np.nan]))
    assert np.isfinite(forecast(Planner(task, task), cut, 0.5)[1]).all(axis=1).sum() == 8


@pytest.mark.extra("notebook")
def test_results_plot_what_the_page_shows(cart):
    findings = gathered(cart)
    assert findings.diagnosis is not None and findings.best is not None
    units, before, after = {"v": "m/s"}, {"v": 0.3}, {"v": 0.1}
    errors = RulerRow(1.0, unit_by_channel=units, crude=before, with_effects=after)
    for result, titles in (
        (replace(findings.diagnosis, prediction_error=(errors,)), ("v [m/s]",)),
        (findings.standing, ("Utility of each candidate",)),
        (findings.best.candidate, ("x", "v", "force")),
    ):
        drawn = result.plot()
        said = [note.text for note in drawn.layout.annotations]
        for title in titles:
            assert any(text.startswith(title) for text in said), (title, said)
        assert len(drawn.data) >= len(titles)
    traces = findings.best.candidate.plot().data
    np.testing.assert_allclose(traces[0].y, findings.best.candidate.predicted_states[:, 0])


def test_logarithmic_panels_show_what_has_a_logarithm():
    line = curve(np.array([0.1, 1.0, 10.0]), np.array([1e-5, 0.0, 10.0]), "best", "b")
    drawn = panel("p", "x", "y", [line], log=True)
    (left, right), (low, high) = (drawn.layout[axis]["range"] for axis in ("xaxis", "yaxis"))
    assert left < -1 and right > 1 and -6 < low < -5 and 1 < high < 2
    assert [*drawn.data[0]["y"]] == [1e-5, 10.0] and drawn.layout["yaxis"]["type"] == "log"
    assert len(png(Figure("f", "f", "", [drawn]))) > 1000


def test_a_loss_is_drawn_by_its_cost_with_the_smallest_on_top():
    dots = [marks([1, 3], [-100.0, 0.0], "best", "ab"), marks([2], [np.nan], "model", ["failed"])]
    drawn = panel("p", "x", "y", dots, [rule(-10.0, "accepted", "optimum")], loss=True)
    bottom, top = drawn.layout["yaxis"]["range"]
    assert bottom > 2 > 1 > top and drawn.layout["shapes"][0]["y0"] == 10.0
    known, failed = (trace["y"] for trace in drawn.data)
    assert [*known] == [100.0, 10.0] and failed[0] == pytest.approx(10.0**bottom)
    assert all(float(t.replace("−", "-")) < 0 for t in drawn.layout["yaxis"]["ticktext"])


@given(st.floats(-12, 6), st.floats(0.05, 12))
def test_a_logarithmic_axis_says_its_magnitude(low, span):
    ticks = log_ticks(low, low + span)
    assert len(ticks) >= 2 and ticks == sorted(ticks)
    assert all(low - 0.05 <= np.log10(tick) <= low + span + 0.05 for tick in ticks)


def test_the_worth_of_each_effect_and_errors_in_the_unit_of_the_state_are_drawn():
    row = RulerRow(
        horizon_s=1.0,
        held_out="trials",
        unit_by_channel={"x": "m", "v": "m/s"},
        crude={"x": 0.2, "v": 0.5},
        calibrated={"x": 0.1, "v": 0.4},
        with_effects={"x": 0.1, "v": 0.05},
        noise_floor={"x": 0.05, "v": 0.04},
    )
    credit = (Credit("delay:u", share=0.9), Credit("dead_zone:u", share=0.1))
    verdict = Verdict("several", ("delay:u", "dead_zone:u"), ("late", "dry"))
    found = Diagnosis(verdict, credit=credit, prediction_error=(row,))
    (share,) = credit_figure(found).panels
    assert _bars(share) == [("delay:u", 0.9), ("dead_zone:u", 0.1)]
    (x, v) = accuracy_figure(found).panels
    errors = sorted(float(one["y"][0]) for one in x.curves)
    assert errors == [0.05, 0.1, 0.1, 0.2] and v.title.startswith("v")


def _bars(panel):
    """The label and the value of each bar, from the top."""
    labels, (trace,) = panel.layout["yaxis"]["ticktext"], panel.data
    return [*zip(labels[::-1], trace["x"][::-1].tolist(), strict=True)]


def test_few_candidates_are_the_first_the_improvements_and_the_latest():
    history = many_flights(30).history
    assert few(history, 30) == (list(history), 0)
    shown, left = few(history, 8)
    assert len(shown) == 8 and left == 22
    assert shown[0] is history[0] and shown[-1] is history[-1]
    assert [t.candidate.id for t in shown] == sorted(t.candidate.id for t in shown)
