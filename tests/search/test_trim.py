"""Trim: inputs and free states for which the model follows the prescribed motion."""

import numpy as np

from grounded.search.first_guess import trim
from small_tasks import cart, cart_task, rover, rover_task


def test_a_cart_that_follows_a_known_motion_needs_the_force_of_newton():
    task = cart_task()
    t = 0.05 * np.arange(41)
    x = np.column_stack([1 - np.cos(t), np.sin(t)])
    _, u = trim(task, x, np.array([True, True]))
    np.testing.assert_allclose(u[:, 0], (np.cos(t) + 0.2 * np.sin(t))[:-1], atol=0.1)
    moved = cart.system.step(x[:-1], u, cart.values, 0.05)
    assert np.abs(moved - x[1:]).max() < 2e-3


def test_a_dead_zone_does_not_hold_it_back():
    """At zero input the slope is zero, so the trim also starts from other inputs."""
    task = rover_task(past=np.zeros(2))
    x, u = trim(task, task.target, np.array([True, True, True]))
    assert np.abs(u[:, 0] - 1.0).max() < 0.05 and np.abs(u[:, 1] - 3.0).max() < 0.05
    moved = rover.system.step(task.target[:-1], u, rover.values, 0.05)
    assert np.abs(moved - task.target[1:]).max() < 3e-3
    np.testing.assert_array_equal(x, task.target[:-1])
