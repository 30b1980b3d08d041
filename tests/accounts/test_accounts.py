"""Which story is told of how a log came about: faults of several robots, honest logs, remedies."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.accounts import ROBOTS, driven, faults, named, verdict
from benchmarks.real_systems import ACROBOT, DART_STEERING, EMPS
from facts import holds
from grounded import Model, Param, Trial
from grounded.accounts.commands import clocks_apart, how_inputs_act
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.judge import judge
from grounded.accounts.sound_trials import sound_trials
from grounded.accounts.table import DEGREES, Account
from shared_data import needs_data
from stepped import logged, stepped

ROBOT = {name: make() for name, make in ROBOTS.items()}


@pytest.fixture(scope="module")
def logs():
    """Each robot's trials, and those with each fault."""
    found = {}
    for k, (name, robot) in enumerate(ROBOT.items()):
        rng = np.random.default_rng([6, k])
        trials = driven(robot, rng)
        found[name] = {fault.name: fault for fault in faults(robot, trials, rng)}
    return found


@pytest.mark.parametrize(
    ("robot", "fault"),
    [
        *(
            ("boat", fault)
            for fault in (
                "degrees once",
                "positions: feet",
                "positions exchanged",
                "speeds: knots",
                "heading exchanged",
                "heading: offset",
                "compass heading",
                "commands exchanged",
            )
        ),
        ("car", "lengths: mm"),
        ("boat", "compass, gyro"),
        *(
            ("drone", fault)
            for fault in (
                "angles: degrees",
                "rate: rpm",
                "rate: sign",
                "rate: noise",
                "late rate",
                "velocity exchanged",
                "states early",
                "stuck",
            )
        ),
        ("arm", "joints exchanged"),
        ("arm", "reversed once"),
        ("rover", "angle: degrees"),
        ("rover", "commands: unit"),
    ],
)
def test_a_fault_is_named_with_its_signals(logs, robot, fault):
    one = logs[robot][fault]
    found, _ = named(ROBOT[robot].model, one.trials)
    assert verdict(one, found) == "right", found


@pytest.mark.parametrize("robot", ["boat", "drone"])
def test_nothing_is_told_of_an_honest_log(logs, robot):
    assert named(ROBOT[robot].model, logs[robot]["sound"].trials) == ([], False)


@needs_data
@pytest.mark.parametrize("system", [DART_STEERING, EMPS], ids=["dart", "emps"])
def test_no_log_of_a_real_system_has_another_story(system):
    model, trials = system.model, [t.until(t.known_steps) for t in system.read()[:3]]
    assert judge(model, trials, range(model.n)).told == ()
    assert not any(clocks_apart(model, trial, range(model.n)) for trial in trials)
    assert all(a.sign >= 0 for t in trials for a in how_inputs_act(model, t, range(model.n)))


@needs_data
def test_an_exchange_in_a_real_log_is_named():
    model, trial = ACROBOT.model, ACROBOT.read()[0]
    for pair in ((0, 1), (0, 2), (1, 3)):
        swapped = Account("exchange", pairs=(pair,)).mended(trial)
        (told,) = judge(model, [swapped], range(4)).told
        assert told.account.kind == "exchange" and told.account.touched & {*pair}


def gyro(rng, *, dead=True, steps=600, dt=0.1):
    """A heading that follows a wheel, and a gyro that shows noise alone."""
    model = Model(
        states={"psi": "rad", "r": "rad/s"},
        inputs={"omega": "rad/s"},
        params={"tau": Param(0.2, "s", 0.05, 1.0)},
        angles=("psi",),
        derivative=lambda s, a, p: {"psi": s.r, "r": (a.omega - s.r) / p.tau},
    )
    t = dt * np.arange(steps)
    sent = 0.35 * np.sin(0.3 * t) + 0.2 * np.sin(1.1 * t)
    x = stepped(model, sent, dt) * [1.0, not dead]
    return model, logged(model, x, sent, dt, [0.002, 0.024], rng)


def test_dead_comes_before_exchanged():
    model, trial = gyro(np.random.default_rng(1))
    (told,) = judge(model, [trial], range(2)).told
    assert (told.account.kind, told.account.columns) == ("dead", (1,))
    _, sound = gyro(np.random.default_rng(2), dead=False)
    (told,) = judge(model, [trial, sound], range(2)).told
    assert told.certain and told.trials == (0,)
    looked = sound_trials(model, [trial, sound])
    assert np.isnan(looked.trials[0].states[:, 1]).all()
    assert np.isfinite(looked.trials[1].states[:, 1]).all()


def test_a_refusal_names_the_trials_the_table_and_the_next_command(logs):
    model, odd = ROBOT["car"].model, logs["car"]["positions: mm"].trials
    trials = [replace(trial, id=f"t{k}") for k, trial in enumerate(odd)]
    with pytest.raises(UnusableTrials) as refused:
        sound_trials(model, trials)
    error = refused.value
    assert error.then is not None and error.then.arguments == ("t0", "t1")
    assert error.finding.about == ("x", "y") and error.finding.facts["by"] == 0.001
    assert "[log" not in error.finding.what and "[log.state.x]" in str(error)


def test_what_is_certain_is_corrected_and_keeps_its_key_of_log(logs):
    model, sound = ROBOT["arm"].model, logs["arm"]["sound"].trials
    for name, kind, factor in (
        ("rate: rpm", "degrees", 30 / np.pi),
        ("rate: sign", "sign", -1),
    ):
        fault = logs["arm"][name]
        looked = sound_trials(model, fault.trials)
        (found,) = (one for one in looked.findings if one.kind == kind)
        i = model.state_names.index(found.signal)
        assert found.corrected and found.scale == pytest.approx(factor)
        assert holds(found.log, "scale")
        assert looked.trials[0].states[:, i] == pytest.approx(sound[0].states[:, i])


def test_accounts_undo_what_they_name():
    rng = np.random.default_rng(0)
    trial = Trial(
        rng.normal(size=(9, 3)), rng.normal(size=(8, 2)), 0.1, ("a", "b", "c"), ("u", "w")
    )
    assert Account("unit", (1,), DEGREES).mended(trial).states[:, 1] == pytest.approx(
        trial.states[:, 1] / DEGREES
    )
    compass = Account("sign", (2, 1), -1.0, offset=0.5).mended(trial)
    assert compass.states[:, 2] == pytest.approx(0.5 - trial.states[:, 2])
    assert compass.states[:, 1] == pytest.approx(-trial.states[:, 1])
    mixed = Account("exchange", pairs=((0, 3),)).mended(trial)
    assert mixed.states[:8, 0] == pytest.approx(trial.inputs[:, 0])
    assert mixed.inputs[:, 0] == pytest.approx(trial.states[:8, 0])
    both = Account("exchange", pairs=((3, 4),)).mended(trial)
    assert both.inputs == pytest.approx(trial.inputs[:, ::-1])
    assert Account("pace", (), 1e-3).mended(trial).dt == pytest.approx(1e-4)
    assert np.isnan(Account("dead", (0,)).mended(trial).states[:, 0]).all()
