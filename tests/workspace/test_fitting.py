"""`fit` in a workspace: the sensors first, nothing written that predicts worse, no round trips."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from facts import holds
from grounded.effects.sensor import lagging
from grounded.errors import GroundedError, NextCommand
from grounded.rollout import simulate
from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.documents import write_document
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.last_diagnosis import read_diagnosis, since_diagnosis, usable_ids
from reported import DIAGNOSIS
from workspaces import make

FILTER_S = 0.1


def filtered(v: np.ndarray, tau: float, dt: float) -> np.ndarray:
    """A speed (T + 1,) as a sensor shows it that filters."""
    off, y = 0.0, v.copy()
    for t in range(1, len(v)):
        off = lagging(off, v[t] - v[t - 1], tau, dt)
        y[t] = v[t] + off
    return y


def logs(
    folder: Path, masses: list[float], tau: float = 0.0, steps: int = 40, alike: int = 1
) -> Workspace:
    """A workspace of a cart driven with these masses [kg], the first few by the same commands."""
    w, rng = Workspace(make(folder).folder), np.random.default_rng(0)
    names = (w.base_model.state_names, w.base_model.input_names)
    for k, mass in enumerate(masses):
        robot = w.task.with_model(w.base_model.with_values({"mass": mass}))
        if not 0 < k < alike:
            force = np.repeat(rng.uniform(-4, 4, (steps // 8, 1)), 8, axis=0)
        run = simulate(robot.problem(exact=True), robot.policy(force, None, None))
        seen = run.states + rng.normal(0, 0.002, run.states.shape)
        if tau:
            seen[:, 1] = filtered(run.states[:, 1], tau, 0.05) + rng.normal(0, 0.002, steps + 1)
        write_trial(folder / f"{k}.mcap", Trial(seen, force, 0.05, *names), {"kind": "data"})
        w.ingest(folder / f"{k}.mcap", data=True)
    return w


@pytest.fixture
def misled(tmp_path: Path) -> Workspace:
    """One motion alone was driven with another mass, three times: no other trial confirms it."""
    return logs(tmp_path / "w", [1.4] * 3 + [1.0] * 7, alike=3)


def claimed(
    w: Workspace,
    value: float = 1.2,
    crude: float = 0.3,
    after: float = 0.1,
    named: Sequence[str] = (),
) -> None:
    """A diagnosis of today's trials and model that says what the mass should be."""
    mass = {"value": value - 1.0, "std": 0.01, "interval": [value - 1.02, value - 0.98]}
    row = {"effect": "parameter:mass", "params": {"d": mass}, "claimed": True, "evidence": 40.0}
    ruler = {
        "horizon_s": 1.0,
        "held_out": "trials",
        "unit_by_channel": {"x": "m"},
        "crude": {"x": crude},
        "with_effects": {"x": after},
    }
    made = {"trials": usable_ids(w), "adopted": [], "params": {}, "nominal": {"mass": 1.0}}
    made["named"] = list(named)
    changes = {
        "verdict": {"kind": "effect", "effects": ["parameter:mass"], "sentence": "One."},
        "ranking": [row],
        "parameters": {},
        "prediction_error": [ruler],
        "diagnosed": made,
    }
    w.reports.mkdir(exist_ok=True)
    write_document(w.reports / "diagnosis.json", {**DIAGNOSIS, **changes})


def test_what_the_sensors_filter_is_corrected_before_parameters_are_fitted(tmp_path):
    w = logs(tmp_path / "w", [1.4] * 6, FILTER_S)
    (seen,) = w.preflight()
    assert (seen.signal, seen.kind) == ("v", "lag")
    found = w.fit()
    assert [one.to_json() for one in found.preflight] == [seen.to_json()]
    assert found.fit.params["mass"].value == pytest.approx(1.4, rel=0.02)
    assert found.fit.helps and found.then == NextCommand("fit", ("--apply",))
    said = grounded("-C", w.folder, "fit")
    assert holds(" ".join(said.out.split()), "sensors", "filter", "corrected here")
    w.fit(apply=True)
    assert w.base_model.params["mass"].value == pytest.approx(1.4, rel=0.02)


def test_parameters_are_fitted_without_a_speed_that_follows_from_positions(tmp_path):
    """Nothing was fitted: "the filter diverged at step 1", and `next: fit --apply`."""
    w, rng = Workspace(make(tmp_path / "w").folder), np.random.default_rng(0)
    robot = w.task.with_model(w.base_model.with_values({"mass": 1.4}))
    names = (w.base_model.state_names, w.base_model.input_names)
    for k in range(24):
        force = np.repeat(rng.uniform(-4, 4, (10, 1)), 4, axis=0)
        run = simulate(robot.problem(exact=True), robot.policy(force, None, None))
        seen = run.states.copy()
        seen[:, 0] += rng.normal(0, 0.002, len(seen))
        speed = 0.0
        for t in range(1, len(seen)):
            speed = 0.5 * speed + 0.5 * (seen[t, 0] - seen[t - 1, 0]) / 0.05
            seen[t, 1] = speed
        write_trial(tmp_path / f"{k}.mcap", Trial(seen, force, 0.05, *names), {"kind": "data"})
        w.ingest(tmp_path / f"{k}.mcap", data=True)
    found = w.fit()
    assert "smoothed" in {one.kind for one in found.preflight}
    assert found.fit.helps and found.fit.params["mass"].value == pytest.approx(1.4, rel=0.05)


def test_values_that_predict_worse_are_never_written(misled):
    before = misled.config.file.read_text()
    found = misled.fit()
    assert not found.fit.helps and found.fit.params["mass"].value > 1.05
    assert found.then == NextCommand("diagnose")  # nobody has yet
    with pytest.raises(GroundedError) as refused:
        misled.fit(apply=True)
    assert holds(str(refused.value), "nothing was written", "held-out", "instead of")
    assert refused.value.then == NextCommand("diagnose")
    done = grounded("-C", misled.folder, "fit", "--params", "mass", "--apply")
    assert done.code == 1 and "Traceback" not in done.err
    assert misled.config.file.read_text() == before


def test_trials_of_before_a_change_of_the_robot_can_be_left_out(tmp_path):
    w = logs(tmp_path / "w", [1.0] * 4 + [1.4] * 4)
    newer = ("t0005", "t0006", "t0007", "t0008")
    mixed, found = w.fit(), w.fit(trials=newer)
    assert mixed.trials == tuple(usable_ids(w)) and found.trials == newer
    assert mixed.fit.params["mass"].value < 1.35
    assert found.fit.params["mass"].value == pytest.approx(1.4, rel=0.02)
    assert found.to_json()["trials"] == list(newer)
    said = grounded("-C", w.folder, "fit", "--trials", ",".join(newer))
    assert holds(" ".join(said.err.split()), "t0005, t0006, t0007 and t0008")
    assert found.then == NextCommand("fit", ("--trials", ",".join(newer), "--apply"))
    w.fit(trials=newer, apply=True)
    assert w.base_model.params["mass"].value == pytest.approx(1.4, rel=0.02)
    with pytest.raises(GroundedError) as unknown:
        w.fit(trials=["T0005", "t0009"])
    assert holds(str(unknown.value), "t0009", "t0001", "t0008")
    empty = grounded("-C", w.folder, "fit", "--trials", ",")
    assert empty.code == 1 and holds(empty.err, "--trials", "names no trial")


def test_the_fit_after_a_diagnosis_of_some_trials_is_of_the_same_trials(misled):
    some = ["t0001", "t0004", "t0005", "t0006"]
    claimed(misled, named=some)
    asked = NextCommand("fit", ("--trials", ",".join(some)))
    assert misled.status().then == asked
    misled.fit()  # of other trials
    assert misled.status().then == asked
    assert not misled.fit(trials=some).fit.helps
    assert misled.status().then == NextCommand("adopt", ("parameter:mass",))


def test_a_fit_in_vain_is_not_asked_for_again(misled):
    """`diagnose` said fit, and `fit` said diagnose, for ever."""
    claimed(misled)
    assert misled.status().then == NextCommand("fit")
    adopt = NextCommand("adopt", ("parameter:mass",))
    assert misled.fit(["mass"]).then == NextCommand("fit")  # which was not of everything
    assert misled.fit().then == adopt
    assert misled.status().then == adopt
    claimed(misled, after=0.5)  # which predicts worse, too
    assert misled.status().then.verb not in ("fit", "adopt", "diagnose")
    claimed(misled)
    (misled.reports / "fit.json").write_text("[")
    assert misled.status().then == NextCommand("fit")


def test_a_fit_of_other_trials_or_another_model_says_nothing_of_these(misled):
    misled.fit()
    claimed(misled)
    assert misled.status().then.verb == "adopt"
    misled.discard("t0001")
    claimed(misled)
    assert misled.status().then.verb == "fit"
    misled.fit()
    model = misled.folder / "model.py"
    model.write_text(model.read_text().replace("Param(0.2,", "Param(0.3,"))
    claimed(misled)
    assert misled.status().then.verb == "fit"


@pytest.mark.parametrize(("value", "adopted"), [(1.2, True), (1.19, True), (1.4, False)])
def test_another_value_than_was_claimed_was_not_adopted(misled, value, adopted):
    """`fit --apply` wrote k = 1.20 where 1.58 was claimed: the page said that was adopted."""
    claimed(misled)
    text = misled.config.file.read_text()
    told = f'file = "model.py"\nparams = {{ mass = {value} }}'
    misled.config.file.write_text(text.replace('file = "model.py"', told, 1))
    w = Workspace(misled.folder)
    since = since_diagnosis(w, read_diagnosis(w.reports), usable_ids(w))
    assert since.changed and since.adopted == ("parameter:mass",) * adopted
