"""What a sensor does is mended in [log], or in the program that writes grounded's own trials."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from cli import grounded
from facts import holding, holds
from grounded.accounts.finding import Finding
from grounded.diagnosis.tables import instrument_lines
from grounded.errors import GroundedError
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.diagnosing import instruments_in
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import READ_BY
from grounded_trials.workspace.intake.ingest import ingest_log
from grounded_trials.workspace.user_files.config import read_config
from grounded_trials.workspace.where_to_mend import one_message, where_to_mend
from workspaces import make

LOG = """
[log.state]
x = { path = "/csv.x" }
v = { path = "/csv.v" }

[log.input]
force = { path = "/csv.force" }
"""


def late(T: int = 400) -> Trial:
    """A cart whose speed comes 0.1 s late."""
    t = 0.05 * np.arange(T + 1)
    force = np.cos(3 * t) + np.cos(1.3 * t + 1)
    speed = lambda t: np.sin(3 * t) / 3 + np.sin(1.3 * t + 1) / 1.3  # noqa: E731
    x = -np.cos(3 * t) / 9 - np.cos(1.3 * t + 1) / 1.69
    states = np.column_stack([x, speed(t - 0.1)])
    return Trial(states, force[:-1, None], 0.05, ("x", "v"), ("force",))


def found_in(w: Folder, kind: str = "delay"):
    (one,) = (f for f in instruments_in(Folder(w.folder)) if f.kind == kind)
    return one


def test_a_late_sensor_of_our_own_trials_is_mended_in_the_program(tmp_path):
    w = make(tmp_path / "w")
    write_trial(tmp_path / "own.mcap", late(), {"kind": "data"})
    ingest_log(w, tmp_path / "own.mcap", data=True)
    one = found_in(w)
    assert (one.signal, one.corrected, one.log) == ("v", True, "")
    assert holds(one.advice, "program", "feedback")
    (line,) = (line for line in instrument_lines([one]))
    assert "[log]" not in line and holds(line, "corrected here", "program")
    assert grounded("-C", w.folder, "diagnose", "--instruments", "--json").json["preflight"][0][
        "advice"
    ]


def test_a_late_sensor_of_a_foreign_log_is_mended_in_its_table(tmp_path):
    w, trial = make(tmp_path / "w"), late()
    (w.folder / "grounded.toml").write_text((w.folder / "grounded.toml").read_text() + LOG)
    t = 0.05 * np.arange(trial.steps)
    rows = np.column_stack([t, trial.states[:-1], trial.inputs])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,x,v,force", comments="")
    ingest_log(w, tmp_path / "log.csv", data=True)
    one = found_in(w)
    assert one.log.startswith("delay_s = 0.1")
    # before any candidate ran, a first run swung
    (line,) = (line for line in instrument_lines([one]))
    assert line.count(one.log) == 1  # once it said "for good", and then to adopt instead
    assert holds(line, "If the robot's program gets v as late", "`adopt` sensor_delay:v")
    assert holds(line, "Otherwise (only the log is late", f"set {one.log}", "Do not do both")
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text().replace("[task]\n", "[task]\nfeedback = false\n"))
    assert not found_in(w).advice


def test_a_delay_is_not_removed_from_logs_that_the_model_has(tmp_path):
    """Both were done, as told at x and y: a rover's run of -0.083 became one of -0.407."""
    w, trial = make(tmp_path / "w"), late()
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text() + LOG)
    rows = np.column_stack([0.05 * np.arange(trial.steps), trial.states[:-1], trial.inputs])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,x,v,force", comments="")
    ingest_log(w, tmp_path / "log.csv", data=True)
    added = 'effects = [{ name = "sensor_delay:v", d = 0.1 }]'
    toml.write_text(toml.read_text().replace("[model]\n", f"[model]\n{added}\n", 1))
    ingest_log(Folder(w.folder), tmp_path / "log.csv", data=True)
    toml.write_text(toml.read_text().replace('path = "/csv.v"', 'path = "/csv.v", delay_s = 0.1'))
    np.savetxt(tmp_path / "b.csv", rows[:-5], "%.6f", ",", header="t,x,v,force", comments="")
    with pytest.raises(GroundedError) as refused:
        ingest_log(Folder(w.folder), tmp_path / "b.csv", data=True)
    assert holds(str(refused.value), "[log.state.v] delay_s", "sensor_delay:v", "adopt --undo")
    with pytest.raises(GroundedError) as refused:  # before a run, not only after it
        Workspace(w.folder).propose()
    assert holds(str(refused.value), "[log.state.v] delay_s", "sensor_delay:v", "adopt --undo")


@pytest.mark.parametrize(("topic", "alone"), [("/mocap", False), ("/imu", True)])
def test_one_message_is_late_as_a_whole(tmp_path, topic, alone):
    """A car's heading was called 137 ms late beside its position, from the same stamps."""
    w = make(tmp_path / "w", "car-turn")
    table = LOG.split("[log.input]")[0].replace("v =", "# v =").replace("x =", "# x =")
    table += """x = { path = "/mocap.pose.position.x" }
y = { path = "/mocap.pose.position.y" }
psi = { path = "TOPIC.pose.orientation.@rpy.yaw" }
""".replace("TOPIC", topic)
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text() + table)
    assert one_message(Folder(w.folder)) == (() if alone else ("x", "y", "psi"))


def early_speed(tmp_path, psi="/mocap", v="/wheels.speed", late=("", "", ""), feedback=True):
    """Return the advice on a speed 11 ms earlier than the motion of a car's position."""
    w = make(tmp_path / "w", "car-turn")
    table = f"""
[log.state]
v = {{ path = "{v}" }}
x = {{ path = "/mocap.pose.position.x"{late[0]} }}
y = {{ path = "/mocap.pose.position.y"{late[1]} }}
psi = {{ path = "{psi}.pose.orientation.@rpy.yaw"{late[2]} }}
"""
    text = (w.folder / "grounded.toml").read_text() + table
    fed = f"[task]\nfeedback = {str(feedback).lower()}\n"
    text = re.sub("^feedback = .*\n", "", text, flags=re.M).replace("[task]\n", fed)
    (w.folder / "grounded.toml").write_text(text)
    keys = zip(("x", "y", "psi"), late, strict=True)
    read = {n: {"delay_s": float(said.split()[-1])} for n, said in keys if said}
    w, used = Folder(w.folder), SimpleNamespace(id="t0001")
    meta = {"source_sha256": "0", READ_BY: json.dumps(read)}
    w.trials = lambda: [SimpleNamespace(stored=used, meta=meta)]
    finding = Finding("v", "0.011 s earlier than the motion of x+y", "delay", -0.011)
    return where_to_mend(w, [used], [finding])[0].advice


def test_a_speed_that_is_early_shows_a_late_message(tmp_path):
    """`v: 0.011 s earlier than the motion of x+y` said neither which is wrong nor what to do."""
    said = early_speed(tmp_path / "1")
    assert holds(said, "x, y and psi are in one message", "delay_s = 0.011", "program", "ahead")
    alone = early_speed(tmp_path / "2", psi="/imu", feedback=False)
    assert holds(alone, "x and y are", "delay_s = 0.011") and "program" not in alone
    again = early_speed(tmp_path / "3", late=(", delay_s = 0.004",) * 3)
    assert "delay_s = 0.015" in again
    apart = early_speed(tmp_path / "4", late=(", delay_s = 0.004", "", ""))
    assert not apart and not early_speed(tmp_path / "5", v="/mocap.twist.linear.x")


def test_sensors_that_nothing_is_held_against_are_named_and_not_called_right(tmp_path):
    w, trial = make(tmp_path / "w"), late()
    blind = replace(trial, states=trial.states * [1.0, np.nan])
    write_trial(tmp_path / "blind.mcap", blind, {"kind": "data"})
    ingest_log(w, tmp_path / "blind.mcap", data=True)
    found = grounded("-C", w.folder, "diagnose", "--instruments", "--json").json
    assert found["unheld"] == ["x"]
    said = grounded("-C", w.folder, "diagnose", "--instruments").out
    assert holds(said, "unchecked", "x", "sign", "delay")


def keys_of(log: str) -> dict[str, float]:
    return {key: float(value) for key, value in (part.split(" = ") for part in log.split(", "))}


@pytest.mark.parametrize(
    ("kind", "has", "logged", "mended"),
    [
        ("sign", "scale = -1.0", 1.0, {"scale": 1.0}),
        ("sign", "scale = 0.5, offset = 0.25", lambda v: (-v - 0.25) / 0.5, None),
        ("degrees", "scale = -1.0", -180 / np.pi, {"scale": -np.pi / 180}),
        ("delay", "delay_s = 0.03", 1.0, {"delay_s": 0.1}),
    ],
)
def test_what_log_has_already_is_counted(tmp_path, kind, has, logged, mended):
    """`scale = -1` was said of a signal with `scale = -1`, which changed nothing."""
    w, trial = make(tmp_path / "w"), late()
    table = LOG.replace('v = { path = "/csv.v" }', f'v = {{ path = "/csv.v", {has} }}')
    toml = w.folder / "grounded.toml"
    toml.write_text(toml.read_text() + table)
    t, x, v = 0.05 * np.arange(trial.steps), *trial.states[:-1].T
    v = logged(v) if callable(logged) else logged * v
    rows = np.column_stack([t, x, v, trial.inputs])
    np.savetxt(tmp_path / "log.csv", rows, "%.9f", ",", header="t,x,v,force", comments="")
    ingest_log(w, tmp_path / "log.csv", data=True)
    keys = keys_of(found_in(w, kind).log)
    assert keys == pytest.approx(mended or {"scale": -0.5, "offset": -0.25}, rel=0.05)
    said = ", ".join(f"{key} = {value}" for key, value in keys.items())
    toml.write_text(toml.read_text().replace(has, said))  # read as it was: the same is said
    assert keys_of(found_in(w, kind).log) == keys


@pytest.mark.parametrize(
    ("has", "mended"),
    [
        ("", {"scale": -1, "offset": 1.5}),
        (", offset = 0.25", {"scale": -1, "offset": 1.25}),
        (", scale = 2, offset = 0.25", {"scale": -2, "offset": 1.25}),
        (", scale = -1", {"scale": 1, "offset": 1.5}),
    ],
)
def test_an_offset_that_is_found_adds_to_that_of_log(tmp_path, has, mended):
    w, trial = make(tmp_path / "w"), late()
    table = LOG.replace('v = { path = "/csv.v" }', f'v = {{ path = "/csv.v"{has} }}')
    (w.folder / "grounded.toml").write_text((w.folder / "grounded.toml").read_text() + table)
    t = 0.05 * np.arange(trial.steps)
    rows = np.column_stack([t, trial.states[:-1], trial.inputs])
    np.savetxt(tmp_path / "log.csv", rows, "%.6f", ",", header="t,x,v,force", comments="")
    ingest_log(w, tmp_path / "log.csv", data=True)
    w = Folder(w.folder)
    (used,) = (replace(trial, id=one.stored.id) for one in w.trials())
    compass = Finding("v", "turns the other way", "sign", log="scale = -1, offset = 1.5")
    (one,) = where_to_mend(w, [used], [compass])
    assert keys_of(one.log) == mended


@pytest.mark.parametrize("entry", ["[log.state.v]\ndelay_s = 0.02", "[log.input.force]\nscale = 2"])
def test_an_entry_of_log_without_a_path_is_an_error(tmp_path, entry):
    """It raised none, and changed nothing."""
    w = make(tmp_path / "w")
    (w.folder / "grounded.toml").write_text((w.folder / "grounded.toml").read_text() + entry)
    with pytest.raises(GroundedError, match=holding("path", "is missing", "TrialWriter")):
        read_config(w.folder)
