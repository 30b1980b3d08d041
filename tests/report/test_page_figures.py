"""Figures: thinning that moves nothing, round ticks, and pictures that hold what they should."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from grounded.experiments.pendulum import pendulum_task
from grounded.models import pendulum
from grounded.rollout import simulate
from grounded.search.first_policy import first_policy
from grounded.search.planner import Planner
from grounded.trial import Trial
from grounded_trials.report.figures.axis import Axis, fitted, round_up, thinned, without_astray
from grounded_trials.report.figures.draw import Stroke, draw, svg
from grounded_trials.report.figures.figure import Band, Curve, Dot, Panel
from grounded_trials.report.figures.png import dashed, plain, png
from grounded_trials.report.figures.runs import all_figures, error_figure
from grounded_trials.report.forecast import forecast, forecast_error
from grounded_trials.report.gathering import gather
from grounded_trials.report.scene import scene_of
from grounded_trials.workspace.folder import Folder
from reported import car, cart, many_flights

__all__ = ["car", "cart"]


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 3000), st.integers(0, 10_000), st.sampled_from(["walk", "sine", "noise"]))
def test_thinning_moves_a_line_by_less_than_a_pixel(count, seed, kind):
    rng = np.random.default_rng(seed)
    x = np.linspace(0, 400, count)
    y = {
        "walk": np.cumsum(rng.normal(0, 2, count)),
        "sine": 100 * np.sin(x / rng.uniform(5, 100)),
        "noise": rng.uniform(0, 200, count),
    }[kind]
    kept = thinned(x, y)
    assert kept[0] == 0 and kept[-1] == count - 1
    assert y[kept].max() > y.max() - 0.5 and y[kept].min() < y.min() + 0.5
    assert max(_distance(x, y, kept), default=0.0) < 1.01


def _distance(x, y, kept):
    """How far each point is from the line through the kept ones."""
    for i in range(len(x)):
        k = int(np.searchsorted(kept, i))
        if kept[k] == i:
            continue
        near = kept[max(k - 3, 0) : k + 3]
        a = np.column_stack([x[near[:-1]], y[near[:-1]]])
        d = np.column_stack([x[near[1:]], y[near[1:]]]) - a
        p = np.array([x[i], y[i]]) - a
        length = np.maximum((d**2).sum(axis=1), 1e-12)
        part = np.clip((p * d).sum(axis=1) / length, 0.0, 1.0)
        yield float(np.min(np.hypot(*(p - part[:, None] * d).T)))


def test_thinning_drops_most_of_a_smooth_path():
    t = np.linspace(0, 2 * np.pi, 3001)
    x, y = 200 + 180 * np.cos(t), 200 + 180 * np.sin(t)
    kept = thinned(x, y)
    assert len(kept) < 300
    radius = np.hypot(
        (x[kept][1:] + x[kept][:-1]) / 2 - 200, (y[kept][1:] + y[kept][:-1]) / 2 - 200
    )
    assert np.abs(radius - 180).max() < 0.5


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
def test_ticks_are_round_and_inside(low, span):
    axis = Axis(low, low + span)
    ticks = axis.ticks(6)
    assert len(ticks) <= 7
    for value, text in ticks:
        slack = 1e-6 * span + 2 * np.spacing(abs(low) + span)  # ends and ticks are rounded numbers
        assert low - slack <= value <= low + span + slack
        assert float(text.replace("−", "-")) == pytest.approx(value, abs=0.01 * span + 1e-9)


@given(st.floats(1e-9, 1e9))
def test_steps_are_one_two_or_five(step):
    found = round_up(step)
    assert step * (1 - 1e-6) <= found <= 2.5 * step * (1 + 1e-6)


def test_loss_axes_put_better_higher_and_space_by_ratio():
    axis = Axis(-100.0, -1.0, loss=True)
    places = [float(axis.place(v)) for v in (-100, -10, -1)]
    assert places == pytest.approx([0.0, 0.5, 1.0])
    assert [v for v, _ in axis.ticks()] == sorted(v for v, _ in axis.ticks())


def test_noise_beyond_zero_ends_at_the_top_of_a_loss_axis():
    dots = (
        Dot(1.0, -50.0, "best", "a", error=60.0),
        Dot(2.0, -2.0, "best", "b", error=7.0),
        Dot(3.0, float("nan"), "model", "failed", "cross"),
    )
    panel = Panel("p", "x", "y", dots=dots, bands=(Band(-9.0, 5.0, "other", "n"),), loss=True)
    text = svg(draw(panel), "p")
    assert "nan" not in text and text.count("<circle") == 2


def test_a_run_that_went_astray_does_not_flatten_the_others():
    calm = np.sin(np.linspace(0, 6, 50))
    wild = np.linspace(0, 1e6, 50)
    low, high = fitted(without_astray([calm], [wild]))
    assert low > -6 and high < 6


def test_missing_samples_break_a_line():
    y = np.array([0.0, 1, np.nan, np.nan, 2, 3])
    panel = Panel("p", "x", "y", (Curve(np.arange(6.0), y, "best", "b"),))
    strokes = [s for s in draw(panel).shapes if isinstance(s, Stroke) and s.role == "best"]
    assert [len(s.points) for s in strokes] == [2, 2]


def test_equal_axes_have_one_scale():
    curve = Curve(np.array([0.0, 10.0]), np.array([0.0, 1.0]), "best", "b")
    drawing = draw(Panel("p", "x", "y", (curve,), equal=True))
    assert drawing.x is not None and drawing.y is not None
    across = (drawing.x.high - drawing.x.low) / drawing.box[2]
    up = (drawing.y.high - drawing.y.low) / drawing.box[3]
    assert across == pytest.approx(up)


def test_dashes_cover_what_they_should():
    line = np.array([[0.0, 0], [30, 0], [30, 60]])
    pieces = dashed(line, np.array([6.0, 3.0]))
    drawn = sum(np.hypot(*np.diff(p, axis=0).T).sum() for p in pieces)
    assert drawn == pytest.approx(60)


def test_words_are_spelled_with_letters_that_the_font_has():
    assert plain("log₂ α − 1 … Ünï 漢") == "log2 alpha - 1 ... Uni ?"


@pytest.mark.extra("png")
def test_pictures_are_drawn_in_their_colours(cart):
    from PIL import Image

    figures = all_figures(gather(Folder(cart)))
    assert [f.name for f in figures] == [
        "utility",
        "paths",
        "states",
        "error",
        "inputs",
        "bias",
        "gap",
        "forecast",
    ]
    for figure in figures:
        image = Image.open(io.BytesIO(png(figure)))
        assert image.width >= 900 and image.height >= 300
        counts = image.getcolors(1 << 24)
        assert counts is not None
        colours = {colour for _, colour in counts}
        assert (0, 114, 178) in colours or figure.name in ("error", "forecast"), figure.name


def test_scenes_of_car_aircraft_and_cart(cart, car):
    plane = scene_of(gather(Folder(car)).task.model)
    assert plane.names == ("x", "y") and plane.heading is not None and plane.spatial
    air = scene_of(many_flights(1).task.model)
    assert air.names == ("east", "north", "altitude") and air.map and len(air.attitude) == 3
    assert not scene_of(gather(Folder(cart)).task.model).spatial


def test_rotations_are_right_handed_and_point_along_the_heading():
    task = many_flights(1).task
    scene = scene_of(task.model)
    states = np.random.default_rng(0).uniform(-1, 1, (20, task.model.n))
    R = scene.rotations(states)
    np.testing.assert_allclose(
        np.einsum("tij,tkj->tik", R, R), np.tile(np.eye(3), (20, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    level = np.zeros((1, task.model.n))
    level[0, task.model.state_names.index("psi")] = np.pi / 2  # yawed to the east
    np.testing.assert_allclose(scene.rotations(level)[0][:, 0], [1, 0, 0], atol=1e-12)
    level[0, task.model.state_names.index("psi")] = 0.0
    level[0, task.model.state_names.index("theta")] = 0.3  # pitched up
    assert scene.rotations(level)[0][2, 0] > 0.2


def test_a_forecast_with_the_true_model_stays_on_the_trial():
    task = pendulum_task(pendulum.model)
    policy, _ = first_policy(task)
    made = simulate(task.problem(exact=True), policy)
    names = (task.model.state_names, task.model.input_names)
    trial = Trial(made.states, made.inputs, task.dt, *names, start_inputs=task.past)
    found = forecast(Planner(task, task), trial, 0.5)
    assert found is not None
    real = trial.states[np.maximum(found.steps, 0)]
    np.testing.assert_allclose(found.states[found.steps >= 0], real[found.steps >= 0], atol=1e-9)
    assert forecast_error(Planner(task, task), trial).max() < 1e-9
    times, values = found.curve(0, task.dt)
    assert len(times) == len(values) and np.isnan(values).sum() >= len(found.steps)


def test_a_forecast_of_a_wrong_model_parts_from_the_trial():
    task = pendulum_task(pendulum.model)
    policy, _ = first_policy(task)
    made = simulate(task.problem(exact=True), policy)
    names = (task.model.state_names, task.model.input_names)
    trial = Trial(made.states, made.inputs, task.dt, *names, start_inputs=task.past)
    wrong = task.with_model(task.model.with_values({"m": 1.3}))
    short, long = (forecast_error(Planner(wrong, wrong), trial, s)[0] for s in (0.1, 1.0))
    assert 1e-6 < short < long


def test_a_forecast_of_a_trial_without_steps_is_none():
    task = pendulum_task(pendulum.model)
    names = (task.model.state_names, task.model.input_names)
    trial = Trial(np.full((3, 2), np.nan), np.zeros((2, 1)), task.dt, *names)
    assert forecast(Planner(task, task), trial) is None
    assert np.isnan(forecast_error(Planner(task, task), trial)).all()


def test_what_is_cut_off_is_marked(cart):
    findings = gather(Folder(cart))
    first = findings.first
    assert first is not None
    whole = error_figure(findings)
    assert whole is not None and not any("cut off" in panel.note for panel in whole.panels)
    states = first.trial.states.copy()
    states[20, 0] = findings.task.target[20, 0] - 490.0
    wild = replace(first, trial=replace(first.trial, states=states))
    runs = tuple(wild if run is first else run for run in findings.runs)
    cut = error_figure(replace(findings, runs=runs))
    assert cut is not None
    panel = cut.panels[0]
    assert panel.note == "model’s policy is cut off: it reaches −490"
    assert panel.y_range[0] > -490 and panel.note in svg(draw(panel), "p")
