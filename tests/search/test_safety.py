"""Checks before a candidate goes to a robot, a safe first drive; certainty and the step rule."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import ttest_ind

from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.validation.identifiable import WEAK
from grounded.model import Param
from grounded.models import arm, cart_pole, pendulum
from grounded.plant import Plant
from grounded.rollout import simulate
from grounded.search.candidate import Tried
from grounded.search.design import KnownNoise, design, information
from grounded.search.difference import (
    Difference,
    Repeats,
    in_question,
    with_chance,
    worth_of_start,
)
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.safety import MAX_GAIN, coasting, coasts_out, objections, spread
from grounded.search.standing import standing
from grounded.search.step_size import (
    LARGEST_DAMPING,
    SMALLEST_DAMPING,
    SearchOptions,
    Step,
    after_failure,
    after_success,
)
from grounded.solve import ddp
from grounded.trial import Trial
from grounded_trials.workspace.adopted import planner_of
from small_tasks import cart, cart_task, drive, other, plain_task


@pytest.fixture(scope="module")
def made():
    return propose(cart_task(), [], [], SearchOptions()).candidate


def test_nothing_speaks_against_a_sound_candidate(made):
    assert not objections(cart_task(), made)


@pytest.mark.parametrize(
    ("part", "at", "value"),
    [
        ("feedforward", 7, np.nan),
        ("gain", 7, np.nan),
        ("reference", 7, np.nan),
        ("gain", (3, 0, 1), -2 * MAX_GAIN),  # beyond reason
        ("predicted_states", (40, 1), np.inf),
    ],
)
def test_a_number_that_no_robot_is_to_get(made, part, at, value):
    of = made if hasattr(made, part) else made.policy
    values = np.array(getattr(of, part))
    values[at] = value
    bad = replace(of, **{part: values})
    bad = bad if of is made else replace(made, policy=bad)
    assert len(objections(cart_task(), bad)) == 1


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


def task_of(model, ends, limit, bound):
    """A manoeuvre from rest to rest, in ten seconds, inside bounds of all states."""
    n = model.n
    target = np.outer(WAY, ends)
    safety = {"safety_low": np.full(n, -bound), "safety_high": np.full(n, bound)}
    return plain_task(model, 0.05, target, 10.0, limit, change=0.01, **safety)


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
    known = KnownNoise.of(np.array([0.1 * noise, noise]), ())
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


def tried(*utilities, accepted=True, base="c0001"):
    candidate = SimpleNamespace(id="c", base=base, model="m", way="")
    return Tried(candidate=candidate, trials=(), utilities=utilities, accepted=accepted)


def test_the_probability_is_the_t_tests():
    a, b = (-5.0, -5.4, -4.9), (-4.2, -4.6, -4.5)
    history = [tried(*a), tried(*b)]
    assert Difference(*history, history).probability == pytest.approx(
        1 - ttest_ind(a, b, alternative="less").pvalue
    )
    assert Difference(*history, history).scatter.freedom == 4


def test_more_repeats_of_each_candidate_show_smaller_gains():
    best = replace(tried(*(-1.0,) * 9), deviation=0.1)
    made = SimpleNamespace(id="c2", base="c", promised_over=lambda _: 0.1)
    assert in_question(made, best) and not in_question(made, best, repeats=9)


def test_exact_repeats_show_at_any_utility_that_nothing_scatters():
    first, a, b = tried(-9000.1, -9000.1, -9000.1, base=""), tried(-5.0), tried(-4.0)
    assert Difference(a, b, [first, a, b]).probability == 1.0
    noisy = tried(-9000.1, -9000.2, base="")
    assert not Difference(a, b, [noisy, a, b]).known


@pytest.mark.parametrize(
    ("utility", "repeats", "word"),
    [
        (-3.9, (-4.0, -4.2, -3.8), "maybe better"),  # within the scatter of later repeats
        (-2.0, (-4.0, -4.2, -3.8), "better"),
        (-3.9, (-4.0,), "maybe better"),  # nothing was repeated: the noise is unknown
        (-1.1, (-4.0,), "better"),  # but no run scatters as much
        (-3.9, (-4.0, -4.0, -4.0), "better"),  # a system that repeats itself exactly
    ],
)
def test_a_run_within_the_scatter_of_repeats_is_not_called_better(utility, repeats, word):
    history = [tried(-90.0, base=""), tried(*repeats), tried(utility)]
    pool, befores = Repeats(history), [None, *history]
    told = [with_chance(*two, history, pool) for two in zip(history, befores, strict=False)]
    assert [one.verdict() for one in told] == ["first", "better", word]


def test_a_kept_promise_lowers_the_damping_and_a_broken_one_raises_it():
    assert after_success(Step(0.9), 100.0, 95.0) == Step(pytest.approx(0.03))
    assert after_success(Step(0.1), 100.0, 60.0) == Step(0.1)
    assert after_success(Step(0.1), 100.0, 10.0) == Step(1.0)
    assert after_success(Step(1.0), 100.0, 10.0) == Step(10.0)
    assert after_success(Step(LARGEST_DAMPING), 100.0, 10.0) == Step(LARGEST_DAMPING)
    assert after_success(Step(SMALLEST_DAMPING), 100.0, 100.0) == Step(SMALLEST_DAMPING)


def test_failures_damp_first_and_halve_then():
    step, seen = Step(0.1), []
    while step is not None:
        seen.append((step.damping, step.alpha))
        step = after_failure(step, max_halvings=2)
    assert seen == [
        (0.1, 1.0),
        (1.0, 1.0),
        (10.0, 1.0),
        (100.0, 1.0),
        (LARGEST_DAMPING, 1.0),
        (LARGEST_DAMPING, 0.5),
        (LARGEST_DAMPING, 0.25),
    ]


TASK = cart_task()
PLANT = Plant(other(TASK.model, 1.6))
PLANNER = Planner(TASK, TASK)
OFF = np.array([0.1, 0.0])


class Story:
    """A search whose robot is set down beside [task] start, as far as told."""

    def __init__(self, **options):
        self.options = SearchOptions(**{"tolerance": 0.0} | options)
        self.candidates, self.trials = [], []
        for _ in range(2):
            self.candidates.append(propose(TASK, *self.both, self.options).candidate)
            if len(self.trials) == 0:
                self.run(0)

    @property
    def both(self):
        return self.candidates, self.trials

    def run(self, which, off=0.0, worse=0.0):
        """Run a candidate from `off`; `worse` shifts its positions after the start."""
        start = replace(TASK, start=TASK.start + off)
        trial = drive(start, PLANT, self.candidates[which], seed=len(self.trials))
        states = np.array(trial.states)
        states[1:, 0] += worse
        number = len(self.trials) + 1
        self.trials.append(replace(trial, states=states, id=f"t{number:04d}"))
        return self.now

    @property
    def now(self):
        return standing(TASK, *self.both, self.options, PLANNER.fingerprint)


@pytest.fixture
def story():
    return Story()


def test_a_start_behind_a_late_sensor_costs_as_much(story):
    policy = story.candidates[1].policy
    late = planner_of(TASK, {"sensor_delay:x": {"d": 1.5 * TASK.dt}})
    assert late.plan.model.n > TASK.model.n
    plain, behind = (worth_of_start(planner, policy, OFF) for planner in (PLANNER, late))
    assert behind == pytest.approx(plain, rel=0.3) and behind < 0
