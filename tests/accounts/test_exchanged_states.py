"""Two state columns in each other's place that only the model reveals."""

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from grounded.instruments.predictions.exchanged_states import exchanged_states, judge_exchanged
from grounded.instruments.predictions.mistaken import Mistake

from cli import grounded
from facts import holds
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.sound_trials import sound_trials
from grounded.trial import Trial
from grounded_trials import Workspace
from real_systems import ACROBOT, BAM_KP, EMPS, SYSID
from shared_data import needs_data

PAIRS = list(combinations(range(6), 2))


@pytest.fixture(scope="module")
def turn(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A car's quarter turn of 3 s, by the policy of its crude model."""
    w = Workspace.create(tmp_path_factory.mktemp("w") / "turn", example="car-turn")
    w.propose()
    w.ingest(w.run().trial_file)
    return w


def logged(w: Workspace) -> Trial:
    (trial,) = w.task_trials()
    return trial


def with_heading(trial: Trial, *, rate: float) -> Trial:
    """The same log with a compass heading, and the sign of its gyro."""
    states = np.array(trial.states)
    psi, gyro = (trial.state_names.index(name) for name in ("psi", "psi_rate"))
    states[:, psi] = np.pi / 2 - states[:, psi]
    states[:, gyro] *= rate
    return replace(trial, states=states)


@pytest.mark.parametrize("pair", PAIRS)
def test_any_two_exchanged_states_of_a_car_are_named(turn, pair):
    model, trial = turn.base_model, logged(turn)
    told = exchanged_states(model, Mistake(states=(pair,)).mended(trial), range(6))
    assert told is not None and told.mistake.states == (pair,) and not told.others
    assert told.mended < 0.2 * told.logged


def test_a_log_without_an_exchange_has_none(turn):
    model, trial = turn.base_model, logged(turn)
    assert exchanged_states(model, trial, range(6)) is None
    for rate in (1, -1):  # `way` corrects it; with x and y exchanged the path would fit as well
        assert exchanged_states(model, with_heading(trial, rate=rate), range(6)) is None
    for i, factor in ((4, 57.3), (2, 1000.0), (1, -1.0), (4, -1.0)):
        states = np.array(trial.states)
        states[:, i] *= factor
        assert exchanged_states(model, replace(trial, states=states), range(6)) is None
    assert exchanged_states(model, trial.until(12), range(6)) is None


@needs_data
@pytest.mark.parametrize(
    "system", [ACROBOT, BAM_KP, EMPS, SYSID], ids=["acrobot", "bam", "emps", "sysid"]
)
def test_no_log_of_a_real_system_shows_an_exchange(system):
    model = system.model
    for trial in system.read()[:4]:
        assert exchanged_states(model, trial.until(trial.known_steps), range(model.n)) is None


@needs_data
def test_an_exchange_in_a_real_log_is_named():
    model, trial = ACROBOT.model, ACROBOT.read()[0]
    for pair in combinations(range(4), 2):
        told = exchanged_states(model, Mistake(states=(pair,)).mended(trial), range(4))
        assert told is not None and told.mistake.states == (pair,)


def test_the_trials_with_the_exchange_are_named(turn):
    model, trial = turn.base_model, logged(turn)
    odd = Mistake(states=((2, 4),)).mended(trial)
    trials = [replace(trial, id="t0001"), replace(odd, id="t0002"), replace(odd, id="t0003")]
    with pytest.raises(UnusableTrials) as refused:
        sound_trials(model, trials)
    assert holds(str(refused.value), "t0002, t0003", "x and psi", "[log]")
    assert refused.value.then is not None
    assert refused.value.then.arguments == ("t0002", "t0003")
    judge_exchanged(model, trials[:1])


def test_ingest_and_diagnose_name_the_exchange_and_nothing_else(turn, tmp_path):
    w = Workspace.create(tmp_path / "w", example="car-turn")
    log, swapped = tmp_path / "run.csv", tmp_path / "swapped.csv"
    turn.export("t0001", log)
    head, *rows = log.read_text().splitlines()
    names = head.split(",")
    x, psi = names.index("x"), names.index("psi")
    names[x], names[psi] = "psi", "x"
    swapped.write_text("\n".join([",".join(names), *rows]) + "\n")
    table = "[log]\n" + "".join(
        f'[log.{kind}.{name}]\npath = "/csv.{name}"\n'
        for kind, some in (("state", w.base_model.state_names), ("input", w.base_model.input_names))
        for name in some
    )
    w.config.file.write_text(w.config.file.read_text() + table)
    (done,) = grounded("-C", w.folder, "ingest", "--data", swapped, "--json").json["trials"]
    (fault,) = done["faults"]
    assert holds(fault, "x and psi", "exchanged", "discard t0001")
    said = grounded("-C", w.folder, "diagnose")
    assert said.code == 1 and holds(said.err, "t0001", "x and psi", "exchanged")
    w.discard("t0001")
    (done,) = grounded("-C", w.folder, "ingest", "--data", log, "--json").json["trials"]
    assert not done["faults"]
    assert Path(w.folder, "reports", "diagnosis.json").exists() is False
