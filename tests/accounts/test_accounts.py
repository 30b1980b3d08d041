"""Which story is told of how a log came about, and of a run that a program passed on otherwise."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import grounded as gr
from benchmarks.accounts import ROBOTS, driven, faults, named, verdict
from benchmarks.real_systems import ACROBOT, DART_STEERING, EMPS, SYSID
from facts import holding, holds
from grounded import Model, Param, Trial
from grounded.accounts.commands import clocks_apart, how_inputs_act
from grounded.accounts.finding import UnusableTrials
from grounded.accounts.judge import judge
from grounded.accounts.returned import Kind, stories, suspicion, unit_by_factor
from grounded.accounts.sent import apart, follows, latest
from grounded.accounts.sound_trials import sound_trials
from grounded.accounts.table import DEGREES, Account
from grounded.onboard import Runner
from grounded.plant import Plant
from grounded.search.ask_tell import Search
from shared_data import needs_data
from small_tasks import drive, other, plain_task, rover_task
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
@pytest.mark.parametrize("system", [DART_STEERING, EMPS, SYSID], ids=["dart", "emps", "arm"])
def test_no_log_of_a_real_system_has_another_story(system):
    model, trials = system.model, [t.until(t.known_steps) for t in system.read()]
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


def columns(task, candidate, trial):
    """The columns of a log that are in another unit, and the factor to correct them."""
    some = stories(task, candidate, trial, follows(candidate.policy, trial, latest(task)))
    return next(((one.names, one.by) for one in some if one.kind is Kind.UNIT), ((), 1.0))


MODEL = gr.Model(
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"mass": gr.Param(1.0, "kg", 0.5, 2.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": a.force / p.mass},
)
T = np.linspace(0.0, 1.0, 51)
WAY = np.column_stack([T**3 * (10 - 15 * T + 6 * T**2), np.full(51, np.nan)])
WEIGHTS = {"terminal": [50.0, 0.0], "effort": 0.001, "change": 0.01}
TASK = plain_task(MODEL, 0.02, WAY, [10.0, 0.0], 15.0, **WEIGHTS)


def robot(candidate, units=1.0):
    """A run of a heavier cart with friction that feeds back metres and logs other units."""
    runner, states, inputs = Runner(candidate.policy), [np.zeros(2)], []
    for step in range(candidate.policy.horizon):
        sent = runner.action(step * 0.02, states[-1])
        x, v = states[-1]
        pull = (sent[0] - 0.4 * v - 0.3 * np.tanh(v / 0.01)) / 1.3
        states.append(np.array([x + 0.02 * v, v + 0.02 * pull]))
        inputs.append(sent)
    return gr.Trial(units * np.array(states), np.array(inputs), 0.02, ("x", "v"), ("force",))


@pytest.mark.parametrize(("units", "named"), [(1e3, "mm"), (100.0, "cm"), (1e-3, "km")])
def test_lengths_in_another_unit_are_found_though_all_columns_agree(units, named):
    candidate = gr.Search(TASK).ask()
    names, by = columns(TASK, candidate, robot(candidate, units))
    assert names == ("x", "v")
    assert by == pytest.approx(1 / units)
    assert unit_by_factor(MODEL, names, by) == named
    with pytest.raises(gr.GroundedError, match=f"are in {named}"):
        gr.learn(TASK, lambda c: robot(c, units))
    assert gr.learn(
        TASK, lambda c: robot(c, units), gr.SearchOptions(max_trials=1), check=False
    ).trials


def test_tell_warns_of_the_first_trial_only_and_keeps_it():
    search = gr.Search(TASK)
    with pytest.warns(UserWarning, match="x and v are in mm"):
        search.tell(robot(search.ask(), 1e3))
    assert len(search.trials) == 1
    sound = gr.Search(TASK)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sound.tell(robot(sound.ask()))
        sound.tell(robot(sound.ask()))


@pytest.fixture(scope="module")
def waiting():
    task = rover_task()
    return task, Search(task).ask()


def programmed(task, made, states=lambda x: x, times=lambda t: t, seed=0):
    """Run a candidate in its model, by a program that passes changed states and times."""
    runner, rng = Runner(made.policy), np.random.default_rng(seed)
    x, rows, sent = task.start.copy(), [], []
    for k in range(task.horizon):
        seen = x + rng.normal(0, 0.002, len(x))
        rows.append(seen)
        u = runner.action(times(k * task.dt), states(seen))
        sent.append(u)
        x = task.model.system.step(x[None], 0.9 * u[None], task.model.values, task.dt)[0]
    names = task.model.state_names, task.model.input_names
    return Trial(np.array([*rows, x]), np.array(sent), task.dt, *names, candidate=made.id)


WAYS = {
    "degrees": ({"states": lambda x: x * [1, 1, 180 / np.pi]}, {"unit": "degrees"}),
    "mm": ({"states": lambda x: x * [1e3, 1e3, 1]}, {"unit": "mm"}),
    "cm": ({"states": lambda x: x * [100, 100, 1]}, {"unit": "cm", "states": ("x", "y")}),
    "compass": ({"states": lambda x: x * [1, 1, -1]}, {"states": ("psi",), "times": -1.0}),
    "order": ({"states": lambda x: x[[1, 0, 2]]}, {"passed": ("y", "x", "psi")}),
    "last first": ({"states": lambda x: x[[2, 0, 1]]}, {"passed": ("psi", "x", "y")}),
    "ms": ({"times": lambda t: 1e3 * t}, {"time": "ms"}),
    "clock": ({"times": lambda t: 1.7e9 + t}, {"time": "a clock"}),
    "nothing": ({"states": lambda x: x * np.nan}, {"ran": "c0001"}),
    "zero": ({"times": lambda t: 0 * t}, {"time": "no unit: it stays 0"}),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_the_program_passed_is_named(waiting, way):
    task, made = waiting
    wrong, named = WAYS[way]
    trial = programmed(task, made, **wrong)
    found = suspicion(task, trial, made, [made])
    assert found.why.code == ("run.unfed" if way == "nothing" else "run.passed")
    assert {key: found.why.facts[key] for key in named} == named


@pytest.mark.parametrize("by", [1.0, 1e3, 1e-3, 180 / np.pi, -1.0])
def test_a_column_farther_from_the_prediction_is_told_whatever_its_size(waiting, by):
    task, made = waiting
    run = programmed(task, made)
    wrong = Account("unit", (0,), 1 / by).mended(run)
    assert (apart(made, wrong) > apart(made, run) + 1) == (by != 1)
    names, factor = columns(task, made, wrong)
    assert names == ("x",) * (by != 1)
    assert factor * by == pytest.approx(1.0, rel=0.01)


TOLD = rover_task()
PLANT = Plant(other(TOLD.model, 1.15), latency={"speed": 0.06, "turn": 0.06})
ONE = gr.SearchOptions(max_trials=1)


def run(candidate):
    return drive(TOLD, PLANT, candidate)


def scaled(trial, *by):
    return replace(trial, inputs=trial.inputs * np.array(by))


def nan(trial):
    return replace(trial, states=np.full_like(trial.states, np.nan))


WRONG = [
    (lambda t: scaled(t, 1, -1), ("turn", "opposite sign")),
    (lambda t: scaled(t, -1, -1), ("c0001",)),
    (lambda t: replace(t, inputs=t.inputs + 50), ("c0001", "rms")),
    (lambda t: replace(t, inputs=0 * t.inputs + 0.3), ("c0001", "rms")),
    (lambda t: replace(t, states=0 * t.states), ("c0001", "rms")),
    (lambda t: replace(t, states=t.states + 5), ("c0001", "rms")),
    (nan, ("x", "finite")),
]


@pytest.mark.parametrize(("change", "facts"), WRONG)
def test_a_trial_that_is_not_its_candidate_s_run(change, facts):
    with pytest.raises(gr.TrialRefused, match=holding(*facts)) as refused:
        gr.learn(TOLD, lambda c: change(run(c)), ONE)
    assert refused.value.search.trials == ()
    assert "ingest" not in str(refused.value) and "[log" not in str(refused.value)
    assert len(gr.learn(TOLD, lambda c: change(run(c)), ONE, check=False).trials) == 1
    search = gr.Search(TOLD)
    with pytest.warns(UserWarning, match=holding(*facts)):
        search.tell(change(run(search.ask())))
    assert len(search.trials) == 1


def test_runs_of_their_candidates_under_noise_are_no_reason_to_warn():
    rng, search = np.random.default_rng(0), gr.Search(TOLD)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(3):
            trial = run(search.ask())
            off = rng.normal(0, 1e-3, trial.states.shape)
            search.tell(replace(trial, states=trial.states + off))


def test_a_crash_is_reported():
    search = gr.Search(TOLD)
    with pytest.warns(UserWarning, match=holding("c0001", "30", TOLD.horizon)):
        search.tell(run(search.ask()).until(30))
    assert holds(search.standing.sentence, "c0001", "crashed")
    assert search.standing.history[0].verdict() == "crashed"


def test_adopted_values_must_lie_within_the_bounds():
    name = next(iter(TOLD.model.params))
    bounded = replace(TOLD.model, params=TOLD.model.params | {name: gr.Param(1.0, "1", 0.5, 2.0)})
    search = gr.Search(TOLD.with_model(bounded))
    assert search.adopt({}, {name: 2.0}).planner.task.model.params[name].value == 2.0
    for value in (2.5, 0.1, float("nan"), "1"):
        with pytest.raises(gr.GroundedError, match=holding(name, str(value))):
            search.adopt({}, {name: value})


def test_a_reward_without_a_weight_gives_nothing_to_plan():
    reward = TOLD.reward
    none = {name: 0 * getattr(reward, name) for name in ("state", "terminal", "input")}
    idle = replace(TOLD, reward=replace(reward, **none, input_change=0 * reward.input_change))
    with pytest.raises(gr.GroundedError, match=holding("weight", "0")):
        gr.Search(idle).ask()


def test_a_velocity_in_another_unit_is_corrected_by_a_factor_and_no_key():
    """An open-loop policy's commands show no unit, so the columns are compared."""
    model = gr.Model(
        states={"x": "m", "v": "m/s"},
        inputs={"force": "N"},
        derivative=lambda s, a, p: {"x": s.v, "v": a.force - s.v},
    )
    target = np.column_stack([np.linspace(0, 1, 41), np.full(41, np.nan)])
    weights = {"terminal": [1.0, 0.0], "effort": 0.01, "change": 0.01}
    task = plain_task(model, 0.05, target, [1.0, 0.0], 5.0, **weights, feedback=False)
    search = gr.Search(task)
    trial = drive(task, Plant(model), search.ask())
    with pytest.warns(UserWarning, match=holding("v", "mm")) as told:
        search.tell(replace(trial, states=trial.states * np.array([1.0, 1e3])))
    assert "[log" not in str(told[0].message)
