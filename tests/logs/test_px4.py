"""PX4 logs: angles from quaternions; variances and sensors of other kinds are no states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from rolling import ROLL, WANTED, T
from ulog import ulog

pytest.importorskip("pyulog", reason="needs the extra px4")
US = np.round(T * 1e6).astype(np.int64) + 10**6
YAW = 2.5 * T  # turns beyond pi


def quaternion(roll: np.ndarray, yaw: np.ndarray) -> np.ndarray:
    """(N, 4) w, x, y, z of a roll, then a yaw."""
    (c, s), (k, z) = ((np.cos(a / 2), np.sin(a / 2)) for a in (roll, yaw))
    return np.column_stack([c * k, s * k, s * z, c * z])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    walk = np.cumsum(np.random.default_rng(1).normal(size=400))
    noise = np.random.default_rng(0).normal(size=(400, 3))
    topics = {
        "vehicle_attitude": (US, {"q": quaternion(ROLL + 2e-3 * noise[:, 0], YAW)}),
        "vehicle_attitude_setpoint": (US, {"roll_body": WANTED}),
        "sensor_accel": (US, {k: 9 * noise[:, i] for i, k in enumerate("xyz")}),
        "vehicle_local_position": (
            US,
            {"x": walk, "eph": noise[:, 1] ** 2},
        ),
        "estimator_status": (US, {"x_variance": noise[:, 2] ** 2}),
    }
    return ulog(tmp_path / "flight.ulg", topics)


def test_the_angles_of_a_quaternion_are_numbers_of_the_log(log: Path) -> None:
    path = "/vehicle_attitude.q.@rpy."
    specs = {"roll": SignalSpec(path + "roll"), "yaw": SignalSpec(path + "yaw")}
    found = read_signals(log, specs)
    np.testing.assert_allclose(found["roll"].values, ROLL, atol=0.02)
    np.testing.assert_allclose(np.unwrap(found["yaw"].values), YAW, atol=1e-3)
    assert path + "pitch" in {field.path for field in inspect_log(log).numbers}


def test_no_variance_and_no_accelerometer_is_a_position(log: Path) -> None:
    (x, y, roll), _ = assigned(inspect_log(log), {"x": "m", "y": "m", "roll": "rad"}, {})
    assert x.path == "/vehicle_local_position.x"
    assert not y.path
    assert roll.path == "/vehicle_attitude.q.@rpy.roll"
    others = {path for guess in (x, roll) for path in guess.others}
    assert not [path for path in others if "accel" in path or "var" in path or "eph" in path]
