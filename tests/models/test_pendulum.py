"""The pendulum, the smallest example."""

import numpy as np
import pytest

from grounded.experiments.pendulum import FRICTION, HEAVIER, pendulum_task
from grounded.experiments.pendulum import model as real
from grounded.models.pendulum import model
from stepped import stepped


def swing(of, theta, seconds, torque=0.0, dt=0.002):
    return stepped(of, np.full(round(seconds / dt), torque), dt, [theta, 0.0])


def test_small_swings_have_the_textbooks_period():
    free = model.with_values({"b": 0.0})
    period = 2 * np.pi * np.sqrt(0.5 / 9.81)
    path = swing(free, 0.01, period)
    np.testing.assert_allclose(path[-1], [0.01, 0.0], atol=2e-4)


def test_energy_is_kept_without_damping_and_lost_with_it():
    def energy(of, path):
        g, length = of.params["g"].value, of.params["l"].value
        return 0.5 * (length * path[:, 1]) ** 2 - g * length * np.cos(path[:, 0])

    free = model.with_values({"b": 0.0})
    kept = energy(free, swing(free, 2.0, 3.0))
    assert np.ptp(kept) < 1e-6
    assert energy(model, swing(model, 2.0, 3.0))[-1] < kept[0] - 0.1


def test_hanging_and_standing_are_at_rest():
    for theta in (0.0, np.pi):
        np.testing.assert_allclose(swing(model, theta, 0.1)[-1], [theta, 0.0], atol=1e-9)


def test_the_real_one_is_heavier_and_rubs():
    assert real.params["m"].value == pytest.approx(HEAVIER * model.params["m"].value)
    still = swing(real, 0.0, 0.5, torque=0.5 * FRICTION)
    assert np.abs(still[-1, 0]) < 0.5 * swing(model, 0.0, 0.5, torque=0.5 * FRICTION)[-1, 0]


def test_the_task_goes_from_hanging_to_standing():
    task = pendulum_task(model)
    assert task.target[0, 0] == 0.0 and task.target[-1, 0] == pytest.approx(np.pi)
    assert task.horizon * task.dt == pytest.approx(3.0) and np.isnan(task.target[:, 1]).all()
