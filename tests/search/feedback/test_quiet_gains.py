"""After feedback made inputs oscillate, later policies feed back no more than what ran quietly."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.plant import Noise, Plant
from grounded.search.feedback.oscillation import quiet_gains
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.standing import standing
from grounded.search.step.step_size import SearchOptions
from small_tasks import cart_task, drive, scara, scara_task

OPTIONS = SearchOptions()


def search(latency, runs):
    """Run a search on the arm with friction, rotors, load and a command delay it knows not of."""
    task = scara_task()
    noise = Noise(measurement={"q1": 5e-5, "q2": 5e-5, "w1": 5e-3, "w2": 5e-3})
    late = dict.fromkeys(task.model.input_names, latency)
    run = SimpleNamespace(
        task=task, plant=Plant(scara(1.0), latency=late, noise=noise, substeps=10)
    )
    run.candidates, run.trials = [], []
    for seed in range(runs):
        made = propose(task, run.candidates, run.trials, OPTIONS).candidate
        run.candidates += [made] * (made not in run.candidates)
        run.trials.append(drive(task, run.plant, made, seed))
    run.history = history_of(task, run.candidates, run.trials)
    return run


def history_of(task, candidates, trials):
    model = Planner(task, task).fingerprint
    return standing(task, candidates, trials, OPTIONS, model).history


def gains(made):
    return np.abs(made.policy.gain).mean()


def test_a_step_after_a_loss_of_gentler_gains_has_no_more_than_those():
    run = search(0.03, 4)
    loud, gentle, *steps = run.candidates
    assert gentle.way == "gentler gains" and not run.history[1].accepted
    assert all(one.way == "" and one.base for one in steps)
    assert max(map(gains, steps)) <= 1.05 * gains(gentle) < 0.5 * gains(loud)
    assert all(one.caution > 0 for one in steps)


@pytest.fixture(scope="module")
def told():
    """A cart whose first plan ran, and a function that makes runs of it with other gains."""
    task = cart_task()
    first = propose(task, [], [], OPTIONS).candidate
    plan, T = first.predicted_inputs, first.policy.horizon
    wave = 1.1 * np.ptp(plan) * np.sign(np.sin(np.pi * 12 * (np.arange(T) + 0.5) / T))[:, None]

    def ran(*levels):
        """Return the history of candidates with these shares of the gains; negative: it swung."""
        candidates, trials = [], []
        for i, (level, utility) in enumerate(levels):
            policy = replace(first.policy, gain=abs(level) * first.policy.gain)
            made = replace(first, id=f"c{i + 1:04d}", policy=policy, base="c0001" if i else "")
            run = made.predicted_run
            inputs = run.inputs + wave * (level < 0)
            off = np.zeros_like(run.states)
            off[1:, 0] = np.sqrt(-utility / (10.0 * T))
            candidates.append(made)
            ids = {"candidate": made.id, "id": f"t{i + 1:04d}"}
            trials.append(replace(run, inputs=inputs, states=run.states + off, **ids))
        return history_of(task, candidates, trials)

    return SimpleNamespace(task=task, first=first, ran=ran, wave=wave)


@pytest.mark.parametrize(
    ("levels", "most", "by", "needed"),
    [
        ([(1.0, -9.0), (0.5, -9.0)], None, "", False),
        ([(-1.0, -9.0)], 0.5, "", False),  # none weaker ran: half
        ([(-1.0, -9.0), (0.3, -20.0)], 0.3, "c0002", False),
        ([(0.4, -9.0), (-1.0, -9.0), (0.3, -9.0)], 0.4, "c0001", False),
        ([(-1.0, -9.0), (0.3, -9.0), (0.7, -9.0)], 0.7, "c0003", False),  # it ran quietly, too
        ([(-1.0, -9.0), (0.3, -9.0), (-0.8, -9.0)], 0.375, "c0002", False),  # of the latest
        ([(-1.0, -9.0), (0.8, -9.0), (-0.6, -9.0)], 0.5, "", False),
        ([(-1.0, -9.0), (0.6, -900.0)], 0.5, "", True),  # it fell: the robot needs its gains
    ],
)
def test_feedback_is_bounded_by_what_ran_quietly(told, levels, most, by, needed):
    found = quiet_gains(told.task, told.ran(*levels))
    if most is None:
        assert found is None
        return
    assert (found.by, found.needed) == (by, needed)
    assert found.most == pytest.approx(most)


def test_only_stronger_feedback_is_a_risk(told):
    history = told.ran((-1.0, -9.0), (0.3, -20.0))
    found = quiet_gains(told.task, history)
    loud, gentle = (tried.candidate for tried in history)
    assert found.risk(gentle) is None
    policy = replace(loud.policy, gain=1.5 * loud.policy.gain)
    assert found.risk(loud) and found.risk(replace(loud, id="c0003", policy=policy))
    assert quiet_gains(told.task, history, "another model") is None
