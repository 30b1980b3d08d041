"""Trim: inputs and free states for which the model follows the prescribed motion."""

import numpy as np

from grounded.search.first_guess import trim
from small_tasks import cart, cart_task


def test_a_cart_that_follows_a_known_motion_needs_the_force_of_newton():
    task = cart_task()
    t = 0.05 * np.arange(41)
    x = np.column_stack([1 - np.cos(t), np.sin(t)])
    _, u = trim(task, x, np.array([True, True]))
    np.testing.assert_allclose(u[:, 0], (np.cos(t) + 0.2 * np.sin(t))[:-1], atol=0.1)
    moved = cart.system.step(x[:-1], u, cart.values, 0.05)
    assert np.abs(moved - x[1:]).max() < 2e-3
