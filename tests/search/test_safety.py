"""Checks before a candidate is handed to a robot, and the safe drive that is recorded first."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.identifiable import WEAK
from grounded.model import Param
from grounded.models import arm, cart_pole, pendulum
from grounded.rollout import simulate
from grounded.search.candidate import Tried
from grounded.search.design import KnownNoise, design, information
from grounded.search.improve import propose
from grounded.search.safety import MAX_GAIN, coasting, coasts_out, objections, spread
from grounded.search.step_size import SearchOptions
from grounded.solve import ddp
from grounded.trial import Trial
from small_tasks import cart, cart_task, plain_task


@pytest.fixture(scope="module")
def made():
    return propose(cart_task(), [], [], SearchOptions()).candidate


def test_nothing_speaks_against_a_sound_candidate(made):
    assert not objections(cart_task(), made)


@pytest.mark.parametrize("part", ["feedforward", "gain", "reference"])
def test_a_number_that_is_not_finite(made, part):
    values = np.array(getattr(made.policy, part))
    values[7] = np.nan
    bad = replace(made, policy=replace(made.policy, **{part: values}))
    assert len(objections(cart_task(), bad)) == 1


def test_a_predicted_state_that_is_not_finite(made):
    states = np.array(made.predicted_states)
    states[40, 1] = np.inf
    found = objections(cart_task(), replace(made, predicted_states=states))
    assert len(found) == 1


def test_a_gain_beyond_reason(made):
    gain = np.array(made.policy.gain)
    gain[3, 0, 1] = -2 * MAX_GAIN
    found = objections(cart_task(), replace(made, policy=replace(made.policy, gain=gain)))
    assert len(found) == 1


def test_a_predicted_run_outside_the_safe_region_names_state_time_and_bound():
    low, high = np.array([-np.inf, -np.inf]), np.array([0.9, np.inf])
    task = cart_task(safety_low=low, safety_high=high)
    proposal = propose(task, [], [], SearchOptions())
    assert proposal.candidate is None and proposal.standing.phase == "stopped"
    assert proposal.findings == proposal.standing.findings
    assert [one.code for one in proposal.findings] == ["plan.outside"]


@pytest.mark.parametrize(("base", "off"), [("c0001", (0.0,)), ("c0001", (1.4,)), ("", (0.0, 1.4))])
def test_runs_that_strayed_widen_a_predicted_run(made, base, off):
    task = cart_task(safety_low=np.full(2, -1.4), safety_high=np.full(2, 1.4))
    names = task.model.state_names, task.model.input_names
    runs = tuple(
        Trial(made.predicted_states + np.array([x, 0.0]), made.predicted_inputs, task.dt, *names)
        for x in off
    )
    tried = Tried(replace(made, base=base, way=""), runs, (-1.0,) * len(runs), True)
    against = objections(task, made, spread(task, [tried], made.model))
    assert [one.code for one in against] == ["plan.outside"] * any(off)


def test_who_coasts_out_of_safety_after_a_run_is_found(made):
    task, run = cart_task(latency=np.array([0.1])), made.predicted_run
    states = np.array(run.states)
    states[-1] = 1.0, 2.0
    run = replace(run, states=states)
    moved = coasting(task, run, np.zeros(1))
    assert (moved[0] == states[-1]).all()
    assert np.all(np.diff(moved[:, 0]) > 0)  # it keeps rolling
    pushed = coasting(cart_task(), run, np.zeros(1))
    assert run.inputs[-1] != 0 and moved[2, 1] != pushed[2, 1]  # commands under way still arrive
    bound = np.array([moved[10, 0], np.inf])
    tight = cart_task(safety_low=-np.full(2, np.inf), safety_high=bound)
    assert coasts_out(tight, task, run, np.zeros(1)) is not None
    wide = cart_task(safety_low=-np.full(2, np.inf), safety_high=np.array([99.0, np.inf]))
    assert coasts_out(wide, task, run, np.zeros(1)) is None
    assert coasts_out(cart_task(), task, run, np.zeros(1)) is None


STEPS = 200
T = np.linspace(0.0, 1.0, STEPS + 1)
WAY = 10 * T**3 - 15 * T**4 + 6 * T**5


def task_of(model, ends, limit, bound, held=0.0):
    """A manoeuvre from rest to rest, in ten seconds, inside bounds of all states."""
    n = model.n
    target = np.outer(WAY, ends)
    safety = {"safety_low": np.full(n, -bound), "safety_high": np.full(n, bound)}
    past = np.full(model.m, held)
    return plain_task(model, 0.05, target, 10.0, limit, change=0.01, past=past, **safety)


HANGING = replace(pendulum.model, params={**pendulum.model.params, "g": Param(9.81)})
ROBOTS = {
    "cart": task_of(cart, [1.0, 0.0], 5.0, 3.0),
    "pendulum": task_of(HANGING, [0.5, 0.0], 8.0, 6.0),
    "arm": task_of(arm.model, [0.3, 0.3, 0.0, 0.0], 30.0, 6.0),
    "pole upright": task_of(cart_pole.model, [0.5, 0.0, 0.0, 0.0], 10.0, 2.0),
}


def usual(task):
    found = ddp.solve(task.problem(), np.tile(task.past, (STEPS, 1)))
    names = (task.model.state_names, task.model.input_names)
    run = simulate(task.problem(exact=True), task.policy(found.u, found.K, found.z[:-1]))
    return Trial(run.states, run.inputs, task.dt, *names, start_inputs=task.past)


def left_by(task, run, noise):
    """What a run leaves of each uncertain parameter's standard deviation, as a share of it."""
    known = KnownNoise.of(2 * np.log(0.1 * noise), 2 * np.log(noise), ())
    h = Hypothesis(shift=np.zeros(task.model.system.k), spread=1.0)
    F = information(task, run, h, known)
    shares = np.sqrt(np.diag(np.linalg.inv(F + np.eye(len(F)))))
    return dict(zip(task.model.uncertain, shares, strict=True))


@pytest.mark.parametrize("name", ROBOTS)
def test_a_drive_halves_what_a_manoeuvre_as_long_leaves_open(name):
    task = ROBOTS[name]
    noise = np.full(task.model.n, 0.005)
    drive = design(task, STEPS, noise)
    assert drive is not None and drive.policy.horizon == STEPS
    assert (drive.policy.gain is not None) == (name in ("arm", "pole upright"))
    before, after = left_by(task, usual(task), noise), drive.left
    assert list(after) == list(task.model.uncertain)
    ratio = {one: after[one] / before[one] for one in after}
    assert np.exp(np.mean(np.log([*ratio.values()]))) <= 0.5
    assert all(ratio[one] <= 0.5 for one in ratio if before[one] > WEAK)


@pytest.mark.parametrize("name", ROBOTS)
def test_a_drive_keeps_to_limits_and_safety_as_far_as_the_model_may_be_wrong(name):
    task = ROBOTS[name]
    drive = design(task, STEPS, np.zeros(task.model.n))
    moved = [{name: min(p.value + p.spread, p.reach[1])} for name, p in task.model.params.items()]
    for values in ({}, *moved):
        p = task.model.with_values(values).values
        run = simulate(replace(task.problem(exact=True), p=p), drive.policy)
        assert (run.states >= task.safety_low).all() and (run.states <= task.safety_high).all()
        assert (run.inputs >= task.low).all() and (run.inputs <= task.high).all()
