"""Bodies: links and carriages where the angles say; the joints of a MuJoCo file."""

from __future__ import annotations

import numpy as np
import pytest

from grounded.models import arm, car, cart_pole, pendulum
from grounded_trials.report.bodies import body_of, is_mechanism, scene_of


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
