"""`fit` in a workspace, what is mended in [log] or the program; names are one policy, verified."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holding
from grounded.accounts.finding import Finding
from grounded.effects.sensor import lagging
from grounded.errors import GroundedError, NextCommand
from grounded.rollout import simulate
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.documents import read_document
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.last_diagnosis import read_diagnosis
from grounded_trials.workspace.readings import one_message
from grounded_trials.workspace.where_to_mend import where_to_mend
from workspaces import edit, make

DT = 0.05


def noisy(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return states + rng.normal(0, 0.002, states.shape)


def filtered(states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The speed is shown by a sensor that filters it over 0.1 s."""
    off, v, seen = 0.0, states[:, 1], states.copy()
    for t in range(1, len(v)):
        off = lagging(off, v[t] - v[t - 1], 0.1, DT)
        seen[t, 1] += off
    return noisy(seen, rng)


def logs(
    folder: Path, masses: list[float], shown=noisy, steps: int = 40, alike: int = 1
) -> Workspace:
    """A workspace of a cart driven with these masses [kg], the first few by the same commands."""
    w, rng = Workspace(make(folder).folder), np.random.default_rng(0)
    names = (w.base_model.state_names, w.base_model.input_names)
    for k, mass in enumerate(masses):
        robot = w.task.with_model(w.base_model.with_values({"mass": mass}))
        if not 0 < k < alike:
            force = np.repeat(rng.uniform(-4, 4, (steps // 8, 1)), 8, axis=0)
        run = simulate(robot.problem(exact=True), robot.policy(force, None, None))
        seen = shown(run.states, rng)
        write_trial(folder / f"{k}.mcap", Trial(seen, force, DT, *names), {"kind": "data"})
        w.ingest(folder / f"{k}.mcap", data=True)
    return w


@pytest.fixture
def misled(tmp_path: Path) -> Workspace:
    """One motion alone was driven with another mass, three times: no other trial confirms it."""
    return logs(tmp_path / "w", [1.4] * 3 + [1.0] * 7, alike=3)


def test_what_the_sensors_filter_is_corrected_before_parameters_are_fitted(tmp_path):
    w = logs(tmp_path / "w", [1.4] * 6, filtered)
    (seen,) = w.preflight()
    assert (seen.signal, seen.kind) == ("v", "lag")
    found = w.fit()
    assert [one.to_json() for one in found.preflight] == [seen.to_json()]
    assert found.fit.helps and found.then == NextCommand("fit", ("--apply",))
    w.fit(apply=True)
    assert w.base_model.params["mass"].value == pytest.approx(1.4, rel=0.02)


def test_values_that_predict_worse_are_never_written(misled):
    before = misled.config.file.read_text()
    found = misled.fit()
    assert not found.fit.helps and found.fit.params["mass"].value > 1.05
    assert found.then == NextCommand("diagnose")  # nobody has yet
    with pytest.raises(GroundedError) as refused:
        misled.fit(apply=True)
    assert refused.value.then == NextCommand("diagnose")
    done = grounded("-C", misled.folder, "fit", "--params", "mass", "--apply")
    assert done.code == 1 and "Traceback" not in done.err
    assert misled.config.file.read_text() == before


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


def test_a_late_sensor_of_our_own_trials_has_no_key_of_log(w):
    own(w, late())
    one = found_in(w)
    assert (one.signal, one.corrected, one.log) == ("v", True, "")


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


def searched(folder, **files):
    ended = Workspace(make(folder, **files).folder)
    ended.learn(2)
    return ended


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return searched(tmp_path_factory.mktemp("identity") / "w")


@pytest.fixture
def ended(made, tmp_path):
    return Workspace(shutil.copytree(made.folder, tmp_path / "w"))


def test_every_flipped_bit_of_a_diagnosis_is_found(learnt):
    ended = Workspace(learnt)
    path = learnt / "reports" / "diagnosis.json"
    data, silent = path.read_bytes(), 0
    assert read_diagnosis(ended.reports) is not None
    for bit in range(0, 8 * len(data), 31):
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        path.write_bytes(flipped)
        try:
            read_document(path)
            silent += 1
        except GroundedError:
            pass
    assert silent == 0 and len(data) > 1500
    path.write_bytes(data[:700] + bytes([data[700] ^ 4]) + data[701:])
    assert [one.file for one in ended.verify().damaged] == [str(path)]
    with pytest.raises(GroundedError, match="diagnose again"):
        ended.adopt("viscous_friction:v")


def test_a_diagnosis_without_a_checksum_is_not_adopted(learnt):
    path = learnt / "reports" / "diagnosis.json"
    text = path.read_text()
    path.write_text("{" + text.split(",", 1)[1])
    with pytest.raises(GroundedError, match=holding("diagnosis.json", "checksum")):
        Workspace(learnt).adopt("viscous_friction:v")


def test_a_deleted_trial_is_found_the_last_one_too(ended, which=-1):
    ended.propose()  # this hand-out has seen the last trial
    trials = sorted(ended.store.folder.glob("t*.mcap"))
    assert ended.verify().damaged == ()
    trials[which].unlink()
    (found,) = ended.verify().damaged
    assert "was removed" in found.reason
    assert ended.report().findings.lost


def test_a_deleted_candidate_is_found_unless_a_trial_carries_it(ended):
    waiting = ended.propose().candidate.id
    ended.candidate_path("c0001").unlink()
    assert ended.verify().damaged == ()
    ended.candidate_path(waiting).unlink()
    (found,) = ended.verify().damaged
    assert waiting in found.file


def test_a_slow_propose_does_not_replace_what_was_handed_out(ended, monkeypatch):
    from grounded.search import improve

    plan, quick = improve.propose, []

    def slow(*args, **kwargs):
        proposal = plan(*args, **kwargs)
        if not quick:  # somebody else proposes while this one plans
            quick.append(True)
            other = Workspace(ended.folder)
            quick.append(other.propose().candidate.id)
            quick.append(other.candidate_bytes(quick[1]))
        return proposal

    monkeypatch.setattr(improve, "propose", slow)
    mine = ended.propose()
    assert mine.candidate.id == quick[1] and not mine.proposal.is_new
    assert ended.candidate_bytes(quick[1]) == quick[2] and ended.verify().damaged == ()
