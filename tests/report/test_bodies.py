"""Bodies where the angles say, memory that follows the log, numbers as people read them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from grounded.models import arm, car, cart_pole, pendulum
from grounded.solve.bias import residuals
from grounded.trial import Trial
from grounded_trials.report.bodies import body_of, is_mechanism, scene_of
from grounded_trials.report.forecast import anchored, forecast
from grounded_trials.wording import percent
from grounded_trials.workspace.adopted import planner_of
from small_tasks import cart, cart_task


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
    inputs = np.sin(np.arange(40) / 4)[:, None]
    states, p = np.zeros((41, 2)), cart.with_values({"drag": drag}).values
    for t in range(40):
        states[t + 1] = cart.system.step(states[t][None], inputs[t][None], p, task.dt)[0]
    late = np.r_[np.zeros(DELAY), states[:-DELAY, 0]]
    return Trial(np.column_stack([late, states[:, 1]]), inputs, task.dt, ("x", "v"), ("force",))


def test_a_late_log_is_not_taken_for_what_the_model_lacks():
    task = cart_task()
    planner = planner_of(task, [{"name": "sensor_delay:x", "d": DELAY * task.dt}])
    right, wrong = _logged(task, 0.2), _logged(task, 0.6)
    assert np.abs(residuals(planner.plan, anchored(planner, right))[:, 0]).max() < 1e-9
    free = residuals(planner.plan, planner.lift(wrong))[:, 0]
    kept = residuals(planner.plan, anchored(planner, wrong))[:, 0]
    assert np.abs(kept).max() < 0.2 * np.abs(free).max()


def _missed(planner, trial):
    """The rms error of forecasts of a trial, by state."""
    times, states = forecast(planner, trial, 1.0)
    off = states - trial.states[np.rint(times / trial.dt).astype(int)]
    return np.sqrt(np.nanmean(off**2, axis=0))


def test_a_forecast_starts_where_a_late_and_filtered_log_says_that_the_robot_was():
    task = cart_task()
    effects = [
        {"name": "sensor_delay:x", "d": DELAY * task.dt},
        {"name": "sensor_lag:v", "tau": 0.1},
    ]
    right = _logged(task, 0.2)
    v, a = [0.0], np.exp(-task.dt / 0.1)
    for mean in (right.states[1:, 1] + right.states[:-1, 1]) / 2:
        v.append(a * v[-1] + (1 - a) * mean)
    late = replace(right, states=np.column_stack([right.states[:, 0], v]))
    noisy = replace(late, states=late.states + 1e-3 * np.random.default_rng(0).normal(size=(41, 2)))
    knows, plain = (_missed(planner_of(task, some), noisy) for some in (effects, []))
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
