"""Figures and bodies: thinning that moves nothing, round ticks, what pictures hold."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.parts import Diagnosis, Verdict
from grounded.diagnosis.telling import accuracy_figure
from grounded.experiments.pendulum import pendulum_task
from grounded.figures import Figure, curve, log_ticks, marks, panel, rule
from grounded.model import Model
from grounded.models import arm, car, cart_pole, pendulum
from grounded.rollout import simulate
from grounded.search.first_policy import first_policy
from grounded.search.pictures import few
from grounded.search.planner import Planner
from grounded.solve.bias import residuals
from grounded.trial import Trial
from grounded_trials.report.bodies import body_of, is_mechanism, scene_of
from grounded_trials.report.figures.png import png
from grounded_trials.report.figures.runs import all_figures
from grounded_trials.report.forecast import anchored, forecast
from grounded_trials.wording import percent
from grounded_trials.workspace.adopted import planner_of
from reported import gathered, many_flights
from small_tasks import cart, cart_task
from stepped import logged, stepped

FIGURES = ("utility", "paths", "states", "inputs", "error", "bias")
FIGURES += ("forecast",)


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


def test_errors_are_drawn_in_the_unit_of_the_state():
    row = RulerRow(
        horizon_s=1.0,
        held_out="trials",
        unit_by_channel={"x": "m", "v": "m/s"},
        crude={"x": 0.2, "v": 0.5},
        calibrated={"x": 0.1, "v": 0.4},
        with_effects={"x": 0.1, "v": 0.05},
        noise_floor={"x": 0.05, "v": 0.04},
    )
    verdict = Verdict("several", ("delay:u", "dead_zone:u"), ("late", "dry"))
    found = Diagnosis(verdict, prediction_error=(row,))
    (x, v) = accuracy_figure(found).panels
    errors = sorted(float(one["y"][0]) for one in x.curves)
    assert errors == [0.05, 0.1, 0.1, 0.2] and v.title.startswith("v")


def test_few_candidates_are_the_first_the_improvements_and_the_latest():
    history = many_flights(30).history
    assert few(history, 30) == (list(history), 0)
    shown, left = few(history, 8)
    assert len(shown) == 8 and left == 22
    assert shown[0] is history[0] and shown[-1] is history[-1]
    assert [t.candidate.id for t in shown] == sorted(t.candidate.id for t in shown)


def _body(model):
    return body_of(model, scene_of(model), 0.1)


@pytest.mark.parametrize(
    ("model", "state", "tip"),
    [
        (pendulum.model, [0.0, 0.0], (0.0, -0.5)),  # hangs
        (pendulum.model, [np.pi / 2, 0.0], (0.5, 0.0)),
        (cart_pole.model, [2.0, 0.0, 0.0, 0.0], (2.0, 0.5)),  # stands
        (cart_pole.model, [2.0, np.pi / 2, 0.0, 0.0], (2.5, 0.0)),  # a pole that falls to +x
        (arm.model, [0.0, 0.0, 0.0, 0.0], (2.0, 0.0)),
        (arm.model, [np.pi / 2, -np.pi / 2, 0.0, 0.0], (1.0, 1.0)),
    ],
)
def test_the_tip_is_where_the_angles_say(model, state, tip):
    body = _body(model)
    assert is_mechanism(body)
    np.testing.assert_allclose(body.path(np.array([state]))[0], [tip[0], 0.0, tip[1]], atol=1e-12)


@pytest.mark.parametrize("model", [pendulum.model, cart_pole.model, arm.model])
def test_each_link_ends_at_the_next_joint(model):
    body, states = _body(model), np.random.default_rng(0).normal(size=(5, model.n))
    sticks = body.sticks(states)
    np.testing.assert_array_equal(sticks[:, :-1, 1], sticks[:, 1:, 0])
    np.testing.assert_array_equal(sticks[:, -1, 1], body.path(states))
    np.testing.assert_allclose(
        np.ptp(np.linalg.norm(np.diff(sticks, axis=2), axis=3), axis=0), 0, atol=1e-12
    )


@pytest.mark.parametrize(("heading", "ahead"), [(0.0, (1, 0, 0)), (np.pi / 2, (0, 1, 0))])
def test_a_vehicle_points_ahead(heading, ahead):
    states = np.where(np.array(car.model.state_names) == "psi", heading, 0.0)[None]
    nose = _body(car.model).sticks(states)[0, 0, 0]
    np.testing.assert_allclose(nose / np.linalg.norm(nose), ahead, atol=1e-12)


MJCF = """
<mujoco>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.2 0.1 0.05" mass="1"/>
      <body name="pole" pos="0 0 0.05">
        <joint name="theta" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.03" mass="0.2"/>
        <body name="weight" pos="0 0 1">
          <inertial pos="0 0 0.5" mass="0.3" diaginertia="0.1 0.1 0.1"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="x"/></actuator>
</mujoco>"""


def test_a_mujoco_model_looks_as_its_file_says():
    pytest.importorskip("mujoco", reason="the adapter's extra, .[mujoco]")
    from grounded.adapters import mujoco

    body = _body(mujoco.model(MJCF))
    states = np.array([[0.7, np.pi / 2, 0.0, 0.0]])  # the pole lies along +x
    ends = [[0.7, 0, 0.05], [1.7, 0, 0.05], [2.2, 0, 0.05]]  # pole, weight, the weight's centre
    sticks = body.sticks(states)[0]
    np.testing.assert_allclose(
        sticks[[0, 1, -1]], [[[0.7, 0, 0], ends[0]], ends[:2], ends[1:]], atol=1e-9
    )
    np.testing.assert_allclose(body.path(states)[0], ends[-1], atol=1e-9)
    assert np.isnan(body.path(np.full((1, 4), np.nan))).all()


DELAY = 2  # steps by which x is logged late


def _logged(task, drag):
    """A run of the cart with another drag, its place logged late."""
    inputs = np.sin(np.arange(40) / 4)
    x, v = stepped(cart.with_values({"drag": drag}), inputs, task.dt).T
    late = np.r_[np.zeros(DELAY), x[:-DELAY]]
    return logged(cart, np.column_stack([late, v]), inputs, task.dt)


def test_a_late_log_is_not_taken_for_what_the_model_lacks():
    task = cart_task()
    planner = planner_of(task, {"sensor_delay:x": {"d": DELAY * task.dt}})
    right, wrong = _logged(task, 0.2), _logged(task, 0.6)
    assert np.abs(residuals(planner.plan, anchored(planner, right))[:, 0]).max() < 1e-9
    free = residuals(planner.plan, planner.lift(wrong))[:, 0]
    kept = residuals(planner.plan, anchored(planner, wrong))[:, 0]
    assert np.abs(kept).max() < 0.2 * np.abs(free).max()


def _rms(planner, trial):
    """The rms error of forecasts of a trial, by state."""
    times, states = forecast(planner, trial, 1.0)
    off = states - trial.states[np.rint(times / trial.dt).astype(int)]
    return np.sqrt(np.nanmean(off**2, axis=0))


def test_a_forecast_starts_where_a_late_and_filtered_log_says_that_the_robot_was():
    task = cart_task()
    effects = {"sensor_delay:x": {"d": DELAY * task.dt}, "sensor_lag:v": {"tau": 0.1}}
    right = _logged(task, 0.2)
    v, a = [0.0], np.exp(-task.dt / 0.1)
    for mean in (right.states[1:, 1] + right.states[:-1, 1]) / 2:
        v.append(a * v[-1] + (1 - a) * mean)
    late = replace(right, states=np.column_stack([right.states[:, 0], v]))
    noisy = replace(late, states=late.states + 1e-3 * np.random.default_rng(0).normal(size=(41, 2)))
    knows, plain = (_rms(planner_of(task, some), noisy) for some in (effects, {}))
    assert (knows < 0.5 * plain).all() and (knows < 0.02).all()


@pytest.mark.parametrize(
    ("share", "text"),
    [
        (0.5, "50 %"),
        (0.997, "99.7 %"),
        (0.002, "0.2 %"),
        (1.0, "100 %"),
        (1.5, "150 %"),
        (0.0, "0.0 %"),
        (1e-5, "< 0.1 %"),
        (0.99999, "> 99.9 %"),
        (float("nan"), "-"),
    ],
)
def test_a_share_keeps_its_tenths_where_they_matter(share, text):
    assert percent(share) == text
