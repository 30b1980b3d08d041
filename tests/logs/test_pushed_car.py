"""A car that a duty drives: its skeleton has that input, and no plan is made for an unknown one."""

import re

import numpy as np
import pytest

from cli import grounded
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.starting.begin import begin

FULL, LAG, BASE = 5.0, 0.4, 0.33  # [m/s] at a duty of 1, [s], [m]
STEPS, DT = 1500, 0.02


def driven():
    """A car on duty and steering: t, v, x, y, psi, steering, duty."""
    t = np.arange(STEPS) * DT
    duty = 0.15 + 0.15 * (np.floor(t / 3) % 3) * (t > 1)
    duty[t < 1] = 0.0
    steering = 0.3 * np.sin(0.9 * t)
    rows, (v, x, y, psi) = [], np.zeros(4)
    for now, a, u in zip(t, steering, duty, strict=True):
        rows.append((now, v, x, y, psi, a, u))
        v += DT * (FULL * u - v) / LAG
        x, y = x + DT * v * np.cos(psi), y + DT * v * np.sin(psi)
        psi += DT * v * np.tan(a) / BASE
    return np.array(rows)


def table(folder, *names):
    log = folder / "drive.csv"
    head = ",".join(("t", "v", "x", "y", "psi", *names))
    np.savetxt(log, driven(), "%.5f", ",", header=head, comments="")
    return log


@pytest.mark.parametrize(("name", "unit"), [("motor_pwm", "1"), ("voltage_V", "V")])
def test_a_car_without_a_speed_command_is_driven_by_what_its_log_has(tmp_path, name, unit):
    found = begin(tmp_path / "w", table(tmp_path, "steering", name), kind="car")
    assert [g.path for g in found.inputs] == ["/csv.steering", f"/csv.{name}"]
    model = Workspace(tmp_path / "w").task.model
    own = found.inputs[1].name
    assert own in name and model.inputs == {"steering": model.inputs["steering"], own: unit}
    gain = model.params["gain"]
    assert gain.value == pytest.approx(FULL, rel=0.1)
    assert gain.unit == ("m/s" if unit == "1" else f"m/s/{unit}")
    assert gain.low < FULL / 2 and gain.high > 2 * FULL


@pytest.mark.parametrize(("head", "unit"), [("steering [%]", "1"), ("steering [deg]", "rad")])
def test_a_steering_without_an_angle_is_a_part_of_the_lock(tmp_path, head, unit):
    begin(tmp_path / "w", table(tmp_path, head, "speed_cmd"), kind="car")
    model = Workspace(tmp_path / "w").task.model
    assert model.inputs["steering"] == unit and ("lock" in model.params) == (unit == "1")


def test_no_plan_is_made_for_an_input_that_log_does_not_map(tmp_path):
    """A node sent a speed of 1.6 m/s as the duty of its motor."""
    w = tmp_path / "w"
    begin(w, table(tmp_path, "steering", "duty"), kind="car")
    file = w / "grounded.toml"
    mapped = file.read_text()
    file.write_text(mapped.replace("[log.input.duty]", "[log.input.steering2]"))
    assert grounded("-C", w, "propose").code == 1  # an unknown name
    file.write_text(mapped)
    assert grounded("-C", w, "propose").code == 0
    without = re.sub(r"\[log\.input\.duty\]\npath[^\n]*\n", "", mapped)
    assert without != mapped
    file.write_text(without)
    for refused in (("propose",), ("export", "c0001", "-o", tmp_path / "c.npz")):
        assert grounded("-C", w, *refused).code == 1
    assert not (tmp_path / "c.npz").exists()
    anyway = grounded("-C", w, "export", "c0001", "-o", tmp_path / "c.npz", "--anyway")
    assert anyway.code == 0
    file.write_text(without[: without.index("[log]")])  # no [log] at all: its own simulator
    Workspace(w).propose()
    file.write_text(without + '\n[system]\nmodel = "model.py"\n')
    Workspace(w).propose()
    file.write_text(without)
    with pytest.raises(GroundedError, match=r"maps no .*duty"):
        Workspace(w).propose()


def test_the_input_that_holds_a_robot_at_the_start_of_its_log_is_that_before_a_run(tmp_path):
    """A hover at 2 m, then a climb: at rest 0.8 of the thrust is needed."""
    text = "from grounded import Model, Param\nmodel = Model(\n"
    text += '    states={"z": "m", "w": "m/s"}, inputs={"thrust": "1"},\n'
    text += '    params={"k": Param(12.2625, "m/s^2", 5, 20)},\n'
    text += '    derivative=lambda s, a, p: {"z": s.w, "w": p.k * a.thrust - 9.81},\n)\n'
    (tmp_path / "m.py").write_text(text)
    t = DT * np.arange(500)
    thrust = 0.8 + 0.1 * np.where(t > 2, np.sin(3 * (t - 2)), 0.0)
    w = np.concatenate([[0.0], np.cumsum(DT * (12.2625 * thrust - 9.81))[:-1]])
    z = 2.0 + np.concatenate([[0.0], np.cumsum(DT * w)[:-1]])
    rows = np.column_stack([t, z, w, thrust])
    np.savetxt(tmp_path / "a.csv", rows, "%.5f", ",", header="t,z,w,thrust", comments="")
    begin(tmp_path / "w", tmp_path / "a.csv", model=tmp_path / "m.py")
    assert Workspace(tmp_path / "w").task.past.tolist() == [0.8]
