"""Commands that a candidate's file sends if a program passes it the wrong things."""

import numpy as np
import pytest

from grounded.accounts.returned import Kind, stories, suspicion
from grounded.accounts.sent import follows, latest
from grounded.onboard import Runner
from grounded.search.ask_tell import Search
from grounded.trial import Trial
from small_tasks import rover_task


@pytest.fixture(scope="module")
def waiting():
    task = rover_task()
    return task, Search(task).ask()


def misused(task, made, trial, plain, *, acts=False):
    """What the program passed to its candidate, by the likeliest story of that."""
    some = stories(task, made, trial, plain, acts=acts)
    return next((one.finding for one in some if one.kind is Kind.PROGRAM), None)


def driven(task, made, states=lambda x: x, times=lambda t: t, seed=0):
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
    "minutes": ({"times": lambda t: t / 60}, {"time": "minutes"}),
    "clock": ({"times": lambda t: 1.7e9 + t}, {"time": "a clock"}),
    "nothing": ({"states": lambda x: x * np.nan}, {"ran": "c0001"}),
    "zero": ({"times": lambda t: 0 * t}, {"time": "no unit: it stays 0"}),
}


@pytest.mark.parametrize("way", WAYS)
def test_what_the_program_passed_is_named(waiting, way):
    task, made = waiting
    wrong, named = WAYS[way]
    trial = driven(task, made, **wrong)
    found = suspicion(task, trial, made, [made])
    assert found.why.code == ("run.unfed" if way == "nothing" else "run.passed")
    assert {key: found.why.facts[key] for key in named} == named


def test_a_run_that_sent_commands_is_not_told_to_be_past_its_end(waiting):
    task, made = waiting
    trial = driven(task, made, times=lambda t: 1.7e9 + t)
    plain = follows(made.policy, trial, latest(task))
    assert misused(task, made, trial, plain).facts["time"] == "a clock"
    assert misused(task, made, trial, plain, acts=True) is None
