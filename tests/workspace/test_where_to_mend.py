"""What a sensor does is mended in [log], or in the program that writes grounded's own trials."""

from dataclasses import replace

import numpy as np
import pytest

from facts import holding
from grounded.accounts.finding import Finding
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.readings import one_message
from grounded_trials.workspace.where_to_mend import where_to_mend
from workspaces import edit, make


def late(steps: int = 400) -> Trial:
    """A cart whose speed comes 0.1 s late."""
    t = 0.05 * np.arange(steps + 1)
    x = -np.cos(3 * t) / 9 - np.cos(1.3 * t + 1) / 1.69
    before = t - 0.1
    v = np.sin(3 * before) / 3 + np.sin(1.3 * before + 1) / 1.3
    force = np.cos(3 * t) + np.cos(1.3 * t + 1)
    states = np.column_stack([x, v])
    return Trial(states, force[:-1, None], 0.05, ("x", "v"), ("force",))


def table(has: str = "") -> str:
    """A [log] of three columns, with keys of the speed."""
    columns = f'x = {{ path = "/csv.x" }}\nv = {{ path = "/csv.v"{has} }}\n'
    return f'\n[log.state]\n{columns}[log.input]\nforce = {{ path = "/csv.force" }}\n'


@pytest.fixture
def w(tmp_path):
    return Workspace(make(tmp_path / "w").folder)


def own(w, trial) -> None:
    write_trial(w.folder / "own.mcap", trial, {"kind": "data"})
    w.ingest(w.folder / "own.mcap", data=True)


def foreign(w, has="", logged=lambda v: v, name="log.csv", rows=None) -> None:
    """Ingest a foreign log of the late cart, whose speed is in other units."""
    toml, trial = w.config.file, late()
    if "[log.state]" not in toml.read_text():
        toml.write_text(toml.read_text() + table(has))
    x, v = trial.states[:-1].T
    values = np.column_stack([0.05 * np.arange(trial.steps), x, logged(v), trial.inputs])[:rows]
    np.savetxt(w.folder / name, values, "%.9f", ",", header="t,x,v,force", comments="")
    w.ingest(w.folder / name, data=True)


def found_in(w, kind: str = "delay"):
    (one,) = (f for f in w.preflight() if f.kind == kind)
    return one


def keys_of(log: str) -> dict[str, float]:
    return {key: float(value) for key, value in (part.split(" = ") for part in log.split(", "))}


def test_a_late_sensor_of_our_own_trials_is_mended_in_the_program(w):
    own(w, late())
    one = found_in(w)
    assert (one.signal, one.corrected, one.log) == ("v", True, "") and one.advice
    assert one.to_json()["advice"] == one.advice


def test_a_delay_is_not_removed_from_logs_that_the_model_has(w):
    foreign(w)
    edit(w.folder, effects='{ name = "sensor_delay:v", d = 0.1 }')
    foreign(w, name="again.csv")
    toml = w.config.file
    toml.write_text(toml.read_text().replace('path = "/csv.v"', 'path = "/csv.v", delay_s = 0.1'))
    for asked in (lambda: foreign(w, name="b.csv", rows=-5), w.propose):
        with pytest.raises(GroundedError, match=holding("[log.state.v] delay_s", "sensor_delay:v")):
            asked()


@pytest.mark.parametrize(("topic", "alone"), [("/mocap", False), ("/imu", True)])
def test_one_message_is_late_as_a_whole(tmp_path, topic, alone):
    w = make(tmp_path / "w", "car-turn")
    paths = {"x": "/mocap.pose.position.x", "y": "/mocap.pose.position.y"}
    paths["psi"] = f"{topic}.pose.orientation.@rpy.yaw"
    rows = "".join(f'{name} = {{ path = "{path}" }}\n' for name, path in paths.items())
    toml = w.folder / "grounded.toml"
    toml.write_text(f"{toml.read_text()}\n[log.state]\n{rows}")
    assert one_message(Folder(w.folder)) == (() if alone else ("x", "y", "psi"))


@pytest.mark.parametrize(
    ("kind", "has", "logged", "mended"),
    [
        ("sign", "scale = -1.0", lambda v: v, {"scale": 1.0}),
        (
            "sign",
            "scale = 0.5, offset = 0.25",
            lambda v: (-v - 0.25) / 0.5,
            {"scale": -0.5, "offset": -0.25},
        ),
        ("delay", "delay_s = 0.03", lambda v: v, {"delay_s": 0.1}),
    ],
)
def test_what_log_has_already_is_counted(w, kind, has, logged, mended):
    foreign(w, f", {has}", logged)
    keys = keys_of(found_in(w, kind).log)
    assert keys == pytest.approx(mended, rel=0.05)
    said = ", ".join(f"{key} = {value}" for key, value in keys.items())
    toml = w.config.file
    toml.write_text(toml.read_text().replace(has, said))  # read as it was: the same is said
    assert keys_of(found_in(w, kind).log) == keys


@pytest.mark.parametrize(
    ("has", "mended"),
    [
        ("", {"scale": -1, "offset": 1.5}),
        (", scale = 2, offset = 0.25", {"scale": -2, "offset": 1.25}),
    ],
)
def test_an_offset_that_is_found_adds_to_that_of_log(w, has, mended):
    foreign(w, has)
    (used,) = (replace(late(), id=one.stored.id) for one in w.trials())
    compass = Finding("v", None, "sign", keys={"scale": -1.0, "offset": 1.5})
    (one,) = where_to_mend(w, [used], [compass])
    assert keys_of(one.log) == mended
