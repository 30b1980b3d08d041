"""LeRobot's data sets: an episode is a trial, in both layouts, and three commands diagnose them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.log_paths import log_files, logs_in
from grounded_trials.logs.signals import SignalSpec, read_signals
from lerobot import FPS, dataset

pytest.importorskip("pyarrow", reason="needs the extra parquet")
NAMES = ["shoulder_pan.pos", "gripper.pos"]
TAU, LATE = 0.2, 3  # [s], and steps, by which the joints follow their actions


def episode(k: int, steps: int = 150) -> dict[str, np.ndarray]:
    """Joints that follow their actions with a lag and a delay."""
    rng, t = np.random.default_rng(k), np.arange(steps) / FPS
    action = np.column_stack(
        [20 * np.sin(t * (1 + 0.2 * k + i)) + 9 * np.sign(np.sin(2.1 * t + i)) for i in range(2)]
    )
    state = np.zeros_like(action)
    for i in range(1, steps):
        step = 1 - np.exp(-1 / FPS / TAU)
        state[i] = state[i - 1] + step * (action[max(i - 1 - LATE, 0)] - state[i - 1])
    return {"action": action, "observation.state": state + 0.02 * rng.normal(size=state.shape)}


@pytest.fixture(params=["v2.1", "v3.0"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return dataset(tmp_path / "so100", request.param, NAMES, [episode(k) for k in range(3)])


def test_each_episode_is_a_log(folder: Path) -> None:
    logs = logs_in(folder)
    assert [log.name for log in logs] == [f"episode_{k:06d}" for k in range(3)]
    assert log_files(folder) == (logs[0],)
    specs = {"u": SignalSpec("/action.gripper"), "q": SignalSpec("/observation/state.gripper")}
    for k, log in enumerate(logs):
        found = read_signals(log, specs)
        for name, key in (("u", "action"), ("q", "observation.state")):
            wanted = episode(k)[key][:, 1].astype(np.float32)
            np.testing.assert_allclose(found[name].values, wanted)
            np.testing.assert_allclose(found[name].t, np.arange(150) * 1e9 / FPS, atol=1)
    paths = {field.path for field in inspect_log(folder).numbers}
    assert paths == {f"/{t}.{n}" for t in ("action", "observation/state") for n in _bare()}


def _bare() -> list[str]:
    return [name.removesuffix(".pos") for name in NAMES]


def test_an_episode_that_is_not_there_is_refused(folder: Path) -> None:
    with pytest.raises(GroundedError, match=holding("episode_000009", 2)):
        inspect_log(folder / "episode_000009")


@pytest.mark.parametrize(
    "damage",
    [
        {"fps": 0},
        {"features": 3},
        {"total_episodes": 10**12},
        {"data_path": "../secret.parquet"},
        {"data_path": "{0.__class__}"},
        "not json",
        "[" * 10**5,
    ],
)
def test_a_damaged_listing_is_refused(folder: Path, damage: object) -> None:
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    path.write_text(damage if isinstance(damage, str) else json.dumps(info | dict(damage)))
    with pytest.raises(GroundedError):
        inspect_log(folder)


def test_names_that_are_none_are_numbered(tmp_path: Path) -> None:
    twice = ["gripper", "gripper"]
    one = dataset(tmp_path / "a", "v2.1", twice, [episode(0)])
    two = dataset(tmp_path / "b", "v3.0", ["dim", "dim"], [episode(0), episode(1)])
    info = json.loads((two / "meta" / "info.json").read_text())
    for feature in info["features"].values():
        feature["names"] = ["dim"]
    (two / "meta" / "info.json").write_text(json.dumps(info))
    assert "/action.gripper_1" in inspect_log(one).moving
    assert "/action.value[1]" in inspect_log(two).moving


def test_every_episode_is_stored_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    dataset(tmp_path / "so100", "v3.0", NAMES, [episode(k) for k in range(3)])
    monkeypatch.chdir(tmp_path)
    assert grounded("init", "arm", "--from", "so100", "--yes").code == 0
    assert grounded("-C", "arm", "ingest", "--data", "so100").code == 0
    again = json.loads(grounded("-C", "arm", "ingest", "--data", "so100", "--json").out)
    assert [one["known"] for one in again["trials"]] == [True] * 3
    last = Workspace("arm").ingest("so100", data=True)  # in Python it is all of them, too
    assert last.known and last.trial == "t0003"
