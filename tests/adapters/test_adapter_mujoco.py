"""The MuJoCo adapter: names, numbers, parameters, rotations, determinism, and errors."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from facts import holding

mj: Any = pytest.importorskip("mujoco", reason="the adapter's extra, .[mujoco]")

from grounded.adapters import mujoco as adapter  # noqa: E402
from grounded.adapters.files import load  # noqa: E402
from grounded.adapters.stepper import Stepper  # noqa: E402
from grounded.errors import GroundedError  # noqa: E402
from grounded.model import Model  # noqa: E402
from stepped import stepped  # noqa: E402

PENDULUM = """
<mujoco model="pendulum">
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 -1 0" damping="0.1"/>
      <geom type="sphere" pos="0 0 -0.5" size="0.01" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-2 2" gear="3"/></actuator>
</mujoco>"""

CART_POLE = """
<mujoco model="cart-pole">
  <option timestep="0.0005" integrator="RK4"/>
  <worldbody>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1.0" contype="0"/>
      <body name="pole">
        <joint name="theta" axis="0 1 0"/>
        <inertial pos="0 0 0.5" mass="0.2" diaginertia="0.01 0.01 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="x" ctrlrange="-10 10"/></actuator>
</mujoco>"""

ARM = """
<mujoco>
  <option timestep="0.01" integrator="implicitfast"/>
  <worldbody>
    <body name="upper">
      <joint name="shoulder" axis="0 1 0" damping="0.2"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03" mass="1" contype="0"/>
      <body name="fore arm" pos="0.4 0 0">
        <joint name="elbow" axis="0 1 0" frictionloss="{frictionloss}" armature="{armature}"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.03" mass="{mass}" contype="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="shoulder" joint="shoulder"/>
    <general name="servo" joint="elbow" gainprm="{gain}" dyntype="filter" dynprm="{tau}"/>
  </actuator>
</mujoco>"""
NOMINAL = {"frictionloss": 0.1, "armature": 0.01, "mass": 0.5, "gain": 2.0, "tau": 0.1}

FREE = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body name="box" pos="0 0 1"><freejoint/>
      <geom type="box" size="0.1 0.2 0.3" mass="2"/>
      <site name="nozzle"/></body>
    <body name="ball" pos="1 0 0"><joint name="socket" type="ball"/>
      <geom type="box" size="0.1 0.2 0.3" pos="0 0 -0.4" mass="1"/></body>
  </worldbody>
  <actuator><motor name="thrust" site="nozzle" gear="0 0 1 0 0.1 0"/></actuator>
</mujoco>"""

URDF = """
<robot name="slider">
  <link name="base"/>
  <link name="cart"><inertial><mass value="2"/>
    <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="rail" type="prismatic"><parent link="base"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit lower="-9" upper="9" effort="5" velocity="10"/></joint>
</robot>"""


def step(model: Model, x: Any, u: Any, dt: float = 0.02, **values: float) -> Any:
    p = model.with_values(values).values
    return model.system.step(np.atleast_2d(x), np.atleast_2d(u), p, dt)


def test_pendulum_has_the_names_units_angles_and_limits_of_the_file() -> None:
    model = adapter.model(PENDULUM, params=("pole.mass", "hinge.damping", "motor.gear"))
    assert model.name == "pendulum"
    assert dict(model.states) == {"hinge": "rad", "hinge_vel": "rad/s"}
    assert dict(model.inputs) == {"motor": "1"}
    assert model.angles == ("hinge",)
    values = {name: (p.value, p.unit, p.low) for name, p in model.params.items()}
    assert values["pole_mass"] == (1.0, "kg", 0.0)
    assert values["hinge_damping"] == (0.1, "N m s/rad", 0.0)
    assert values["motor_gear"] == (3.0, "1", 0.0)
    assert adapter.limits(PENDULUM) == {"motor": (-2.0, 2.0)}
    assert adapter.model(PENDULUM, params={"pole.mass": (0.5, 2)}).params["pole_mass"].high == 2


def cart_pole(x: Any, force: Any) -> Any:
    """ds/dt in plain NumPy: pole upright at zero, point of mass at 0.5 m, own inertia 0.01."""
    M, m, length, inertia, g = 1.0, 0.2, 0.5, 0.01, 9.81
    _, theta, speed, rate = x.T
    s, c = np.sin(theta), np.cos(theta)
    mass = np.array([[np.full_like(c, M + m), m * length * c], [m * length * c, 0 * c]])
    mass[1, 1] = inertia + m * length**2
    right = np.array([force + m * length * rate**2 * s, m * g * length * s])
    found = np.linalg.solve(mass.transpose(2, 0, 1), right.T[:, :, None])[:, :, 0]
    return np.stack([speed, rate, *found.T], axis=1)


def test_cart_pole_is_the_plain_numpy_cart_pole() -> None:
    model = adapter.model(CART_POLE)
    assert model.state_names == ("x", "theta", "x_vel", "theta_vel")
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(40, 4)), rng.normal(size=(40, 1))
    k1 = cart_pole(x, u[:, 0])
    k2 = cart_pole(x + 0.005 * k1, u[:, 0])
    k3 = cart_pole(x + 0.005 * k2, u[:, 0])
    k4 = cart_pole(x + 0.01 * k3, u[:, 0])
    expected = x + 0.01 / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    np.testing.assert_allclose(step(model, x, u, dt=0.01), expected, atol=1e-7)


def test_arm_with_an_activation_and_names_that_collide() -> None:
    model = adapter.model(ARM.format(**NOMINAL), params=("fore arm.mass",))
    assert model.state_names == ("shoulder", "elbow", "shoulder_vel", "elbow_vel", "servo_act")
    assert model.input_names == ("shoulder_ctrl", "servo")
    assert model.param_names == ("fore_arm_mass",)
    moved = step(model, np.zeros(5), [0.0, 1.0], dt=0.01)[0]
    assert moved[4] == pytest.approx(0.01 / 0.1)  # a first-order filter of 0.1 s


def test_arm_with_parameters_is_the_arm_of_a_file_with_these_numbers() -> None:
    specs = ("fore arm.mass", "elbow.frictionloss", "elbow.armature", "servo.gain", "servo.tau")
    model = adapter.model(ARM.format(**NOMINAL), params=specs)
    other = {"frictionloss": 0.4, "armature": 0.05, "mass": 1.3, "gain": 3.0, "tau": 0.2}
    rng = np.random.default_rng(1)
    x, u = rng.normal(size=(20, 5)), rng.normal(size=(20, 2))
    values = {f"elbow_{k}": other[k] for k in ("frictionloss", "armature")}
    values |= {f"servo_{k}": other[k] for k in ("gain", "tau")}
    changed = step(model, x, u, fore_arm_mass=other["mass"], **values)
    recompiled = step(adapter.model(ARM.format(**other)), x, u)
    np.testing.assert_allclose(changed, recompiled, atol=1e-9)
    nominal = step(model, x, u)  # and back
    np.testing.assert_array_equal(nominal, step(adapter.model(ARM.format(**NOMINAL)), x, u))


def test_torques_instead_of_actuators() -> None:
    model = adapter.model(ARM.format(**NOMINAL), inputs=("elbow",))
    assert model.input_names == ("elbow_torque",) and model.inputs["elbow_torque"] == "N m"
    at_rest, pushed = step(model, np.zeros((1, 5)), [[0.0]]), step(model, np.zeros((1, 5)), [[1.0]])
    assert pushed[0, 3] > at_rest[0, 3]
    both = adapter.model(ARM.format(**NOMINAL), inputs="torques")
    assert both.input_names == ("shoulder_torque", "elbow_torque")


def test_urdf_without_actuators_gets_forces_and_effort_limits(tmp_path: Path) -> None:
    file = tmp_path / "slider.urdf"
    file.write_text(URDF)
    model = adapter.model(file)
    assert dict(model.states) == {"rail": "m", "rail_vel": "m/s"}
    assert dict(model.inputs) == {"rail_force": "N"}
    assert model.angles == ()
    assert adapter.limits(file) == {"rail_force": (-5.0, 5.0)}
    moved = step(model, [0.0, 0.0], [4.0])[0]
    assert moved[1] == pytest.approx(4.0 / 2.0 * 0.02)


def test_rotations_are_the_tangent_of_mujoco() -> None:
    model, compiled = adapter.model(FREE), load(FREE)
    assert model.state_names[:6] == ("box_x", "box_y", "box_z", "box_rx", "box_ry", "box_rz")
    assert model.state_names[6:9] == ("socket_rx", "socket_ry", "socket_rz")
    assert model.state_names[9:12] == ("box_vx", "box_vy", "box_vz")
    coordinates = model.step.coordinates  # type: ignore[union-attr]
    r = np.random.default_rng(2).uniform(-1, 1, (5, 9))
    for row, qpos in zip(r, coordinates.to_qpos(r), strict=True):
        expected = np.array(compiled.qpos0)
        expected[:3] = 0.0  # positions are the file's own, not relative to the reference
        mj.mj_integratePos(compiled, expected, row, 1.0)
        np.testing.assert_allclose(qpos, expected, atol=1e-12)
    np.testing.assert_allclose(coordinates.from_qpos(coordinates.to_qpos(r), r), r, atol=1e-12)


def test_free_body_turns_on_past_a_full_turn() -> None:
    model = adapter.model(FREE)
    index = model.state_names.index
    x = np.zeros((1, model.n))
    x[0, index("box_rz")], x[0, index("box_wz")] = 3.0, 5.0  # about an axis of inertia
    x = stepped(model, np.zeros((100, model.m)), 0.02, x[0])[-1:]
    assert x[0, index("box_rz")] == pytest.approx(3.0 + 100 * 0.02 * 5.0, abs=1e-9)
    assert x[0, index("box_z")] == 0.0


@pytest.mark.parametrize("threads", [1, 2])
def test_batches_are_single_samples_bit_for_bit(threads: int, monkeypatch) -> None:
    monkeypatch.setattr(adapter, "cores", lambda: threads)
    model = adapter.model(ARM.format(**NOMINAL))
    rng = np.random.default_rng(3)
    many = 2 * adapter.SHARED  # enough samples for several threads
    x, u = rng.normal(size=(many, 5)), rng.normal(size=(many, 2))
    together = step(model, x, u)
    for i in rng.permutation(many):
        np.testing.assert_array_equal(step(model, x[i], u[i])[0], together[i])
    copied = pickle.loads(pickle.dumps(model.step))
    np.testing.assert_array_equal(copied.advance(x, u, model.values, 0.02), together)


def test_derivatives_are_those_of_central_differences() -> None:
    for xml in (ARM.format(**NOMINAL | {"frictionloss": 0.0}), FREE):
        model = adapter.model(xml)
        stepper = model.step
        assert isinstance(stepper, Stepper)
        rng = np.random.default_rng(4)
        x, u = 0.5 * rng.normal(size=(6, model.n)), rng.normal(size=(6, model.m))
        f_x, f_u = stepper.derivatives(x, u, model.values, 0.02)
        X, U = model.system.linearise(x, u, model.values, 0.02)
        np.testing.assert_allclose(f_x, X, atol=2e-5)
        np.testing.assert_allclose(f_u, U, atol=2e-5)
        s = dict(zip(model.state_names, x[0].tolist(), strict=True))
        a = dict(zip(model.input_names, u[0].tolist(), strict=True))
        one, _ = stepper.jacobian(s, a, {}, 0.02)
        np.testing.assert_allclose(one, f_x[0], atol=1e-12)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"params": ("pole.weight",)}, "pole.weight"),
        ({"params": ("polo.mass",)}, "did you mean 'pole'"),
        ({"params": ("mass",)}, "'pole.mass'"),
        ({"inputs": ("hinges",)}, "did you mean 'hinge'"),
        ({"inputs": "torque"}, "inputs must be"),
    ],
)
def test_what_is_not_in_the_file_is_said(options: dict[str, Any], message: str) -> None:
    with pytest.raises(GroundedError, match=message):
        adapter.model(PENDULUM, **options)


def test_a_step_that_is_no_multiple_a_missing_file_and_a_broken_one(tmp_path: Path) -> None:
    with pytest.raises(GroundedError, match=r"timestep .*0\.006"):
        step(adapter.model(PENDULUM), [0, 0], [0], dt=0.012)
    with pytest.raises(GroundedError, match=holding("nothing.xml")):
        adapter.model(tmp_path / "nothing.xml")
    with pytest.raises(GroundedError, match=holding("MJCF", "wrong")):
        adapter.model("<mujoco><wrong/></mujoco>")


MARKED = """
<mujoco><compiler angle="radian"/><option timestep="0.005"/>
  <worldbody>
    <body name="upper"><joint name="lift" axis="0 1 0" range="-3.1 -0.2" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.02" mass="2" contype="0" conaffinity="0"/>
      <body name="tool" pos="0.4 0 0">
        <inertial mass="{mass}" pos="0 0 0" diaginertia="0 0 0"/></body></body>
    <body name="goal" pos="1 0 0"><joint name="goal" type="slide" axis="0 0 1"/>
      <geom size="0.05" contype="{touches}" conaffinity="0"/></body>
    <geom name="floor" type="plane" size="1 1 1" pos="0 0 -5" contype="0" conaffinity="0"/>
  </worldbody>
  <actuator><motor name="lift" joint="lift" gear="3" ctrlrange="-9 9"/></actuator>
</mujoco>"""


def test_a_body_without_mass_can_carry_a_payload():
    empty = adapter.model(MARKED.format(mass=0, touches=0), params=("tool.mass",))
    loaded = adapter.model(MARKED.format(mass=1.5, touches=0))
    x, u = np.array([[-1.0, 0.0, 0.5, 0.0]]), np.array([[1.0]])
    by = empty.system.step(x, u, np.array([1.5]), 0.05)
    assert np.allclose(by, loaded.system.step(x, u, loaded.values, 0.05), rtol=1e-12)
