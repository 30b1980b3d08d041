"""Units that all columns of a run share, shown by the commands that the policy sent."""

import warnings

import numpy as np
import pytest

import grounded as gr
from grounded.accounts.returned import Kind, stories, unit_by_factor
from grounded.accounts.sent import follows, latest
from grounded.onboard import Runner

MODEL = gr.Model(
    states={"x": "m", "v": "m/s"},
    inputs={"force": "N"},
    params={"mass": gr.Param(1.0, "kg", 0.5, 2.0)},
    derivative=lambda s, a, p: {"x": s.v, "v": a.force / p.mass},
)
T = np.linspace(0.0, 1.0, 51)
TASK = gr.Task(
    model=MODEL,
    dt=0.02,
    target=np.column_stack([T**3 * (10 - 15 * T + 6 * T**2), np.full(51, np.nan)]),
    reward=gr.Reward(state=[10.0, 0.0], terminal=[50.0, 0.0], input=[0.001], input_change=[0.01]),
    start=np.zeros(2),
    past=np.zeros(1),
    low=np.array([-15.0]),
    high=np.array([15.0]),
)


def found(task, candidate, trial):
    """The signals and the factor with which a trial is the candidate's run."""
    plain = follows(candidate.policy, trial, latest(task))
    some = stories(task, candidate, trial, plain)
    return next(((one.names, one.by) for one in some if one.kind is Kind.UNIT), ((), 1.0))


def robot(candidate, units=1.0, noise=0.0, late=0):
    """A run of a heavier cart with friction that feeds back metres and logs other units."""
    runner, states, inputs = Runner(candidate.policy), [np.zeros(2)], []
    shaken = np.random.default_rng(0).normal(size=(60, 2)) * noise
    for step in range(candidate.policy.horizon):
        seen = states[max(0, step - late)] + shaken[step]
        sent = runner.action(step * 0.02, seen)
        x, v = states[-1]
        pull = (sent[0] - 0.4 * v - 0.3 * np.tanh(v / 0.01)) / 1.3
        states.append(np.array([x + 0.02 * v, v + 0.02 * pull]))
        inputs.append(sent)
    return gr.Trial(units * np.array(states), np.array(inputs), 0.02, ("x", "v"), ("force",))


@pytest.mark.parametrize(("units", "named"), [(1e3, "mm"), (100.0, "cm"), (1e-3, "km")])
def test_lengths_in_another_unit_are_found_though_all_columns_agree(units, named):
    candidate = gr.Search(TASK).ask()
    names, by = found(TASK, candidate, robot(candidate, units))
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
