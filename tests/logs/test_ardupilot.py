"""ArduPilot's logs: topics, units and instances as the log says; damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rolling
from dataflash import dataflash
from grounded.errors import GroundedError
from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.signals import SignalSpec, read_signals
from rolling import DT, N, T

WANTED, ROLL = 50 * rolling.WANTED, 50 * rolling.ROLL  # [deg]
ROLL += 0.05 * np.random.default_rng(0).normal(size=N)
GYRO = np.deg2rad(np.gradient(ROLL, DT))
KINDS = [
    ("ATT", "Qcc", "TimeUS,DesRoll,Roll", "sdd"),
    ("IMU", "QBf", "TimeUS,I,GyrX", "s#E"),
    ("MSG", "QZ", "TimeUS,Message", "s-"),
]


@pytest.fixture
def log(tmp_path: Path) -> Path:
    messages: list = [("MSG", (10**6, "ArduCopter V4.5"))]
    for t, wanted, roll, gyro in zip(T, WANTED, ROLL, GYRO, strict=True):
        at = 10**6 + round(t * 1e6)
        messages.append(("ATT", (at, round(100 * wanted), round(100 * roll))))
        messages += [("IMU", (at, k, gyro + k)) for k in range(2)]
    return dataflash(tmp_path / "00000012.BIN", KINDS, messages)


def test_messages_are_topics_with_the_units_that_the_log_states(log: Path) -> None:
    specs = {n: SignalSpec(p) for n, p in {"roll": "/ATT.Roll", "p": "/IMU_1.GyrX"}.items()}
    found = read_signals(log, specs)
    np.testing.assert_allclose(found["roll"].values, ROLL, atol=0.0051)
    np.testing.assert_allclose(found["roll"].t, 1e9 + T * 1e9, atol=1000)
    np.testing.assert_allclose(found["p"].values, GYRO + 1, rtol=1e-6, atol=1e-6)
    units = inspect_log(log).about[0].units
    assert units["/ATT.Roll"] == "deg" and units["/IMU.GyrX"] == units["/IMU_1.GyrX"] == "rad/s"
    assert {topic.topic for topic in inspect_log(log).topics} >= {"/ATT", "/IMU", "/IMU_1"}


def test_degrees_and_what_was_desired_are_told_apart(log: Path) -> None:
    (roll,), (sent,) = assigned(inspect_log(log), {"roll": "rad"}, {"roll_command": "rad"})
    assert (roll.path, sent.path) == ("/ATT.Roll", "/ATT.DesRoll")
    assert roll.scale == pytest.approx(np.pi / 180) and sent.scale == roll.scale


def test_another_reader_reads_the_same(log: Path) -> None:
    pymavlink = pytest.importorskip("pymavlink.DFReader", reason="pymavlink is not installed")
    reader, rolls = pymavlink.DFReader_binary(str(log)), []
    while (message := reader.recv_match(type="ATT")) is not None:
        rolls.append(message.Roll)
    reader.data_map.close()
    reader.filehandle.close()
    own = read_signals(log, {"roll": SignalSpec("/ATT.Roll")})["roll"].values
    np.testing.assert_allclose(own, rolls)


def test_damage_costs_the_messages_in_it(log: Path) -> None:
    whole, rng = log.read_bytes(), np.random.default_rng(0)
    for k in range(8):
        bad = bytearray(whole)
        at = len(whole) // 2 + 37 * k
        bad[at : at + 60] = rng.bytes(60)
        log.write_bytes(bytes(bad[: len(bad) - 5 * k]))
        found = read_signals(log, {"roll": SignalSpec("/ATT.Roll")})["roll"].values
        assert N - 8 <= len(found) <= N
        np.testing.assert_allclose(found[:100], ROLL[:100], atol=0.0051)
    log.write_bytes(whole[:200])
    with pytest.raises(GroundedError):
        inspect_log(log)
