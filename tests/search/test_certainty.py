"""How certain an improvement is: scatter between runs and their starts, and the step rule."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import t, ttest_ind

from grounded.plant import Plant
from grounded.search.candidate import Tried
from grounded.search.difference import (
    PIECES,
    Difference,
    Repeats,
    in_question,
    with_chance,
    worth_of_start,
)
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.standing import standing
from grounded.search.step_size import (
    LARGEST_DAMPING,
    SMALLEST_DAMPING,
    SearchOptions,
    Step,
    after_failure,
    after_success,
    losers_of,
)
from grounded_trials.workspace.adopted import planner_of
from small_tasks import cart_task, drive, other


def tried(*utilities, accepted=True, base="c0001"):
    candidate = SimpleNamespace(id="c", base=base, model="m", way="")
    return Tried(candidate=candidate, trials=(), utilities=utilities, accepted=accepted)


def test_the_probability_is_the_t_tests():
    a, b = (-5.0, -5.4, -4.9), (-4.2, -4.6, -4.5)
    history = [tried(*a), tried(*b)]
    assert Difference(*history, history).probability == pytest.approx(
        1 - ttest_ind(a, b, alternative="less").pvalue
    )
    assert Difference(*history, history).freedom == 4


def promising(gain, utilities=(-1.2, -1.0), deviation=0.1, doubtful=False):
    best = replace(tried(*utilities), deviation=deviation)
    made = SimpleNamespace(id="c2", base="c", promised_over=lambda _: gain, doubtful=doubtful)
    return made, best


def test_more_repeats_of_each_candidate_show_smaller_gains():
    made, best = promising(0.1, utilities=(-1.0,) * 9)
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


def runs(pieces, cost=10.0):
    """Return a candidate whose runs have these utilities in each part, plus a common cost."""
    utilities = tuple(float(u) for u in pieces.sum(axis=1) - cost)
    candidate = SimpleNamespace(base="c0001", model="m", id="c0002")
    return Tried(candidate, (None,) * len(pieces), utilities, True, pieces=pieces)


def test_intervals_from_two_repeats_hold_as_often_as_they_say():
    rng = np.random.default_rng(0)
    inside, least, width = [], [], []
    for _ in range(600):
        pair = runs(rng.normal(size=(2, PIECES)))
        scatter = Repeats([pair]).near(pair.utility)
        error = scatter.error(2)
        inside.append(abs(pair.utility + 10.0) < t.ppf(0.95, scatter.freedom) * error)
        least.append(np.sqrt(scatter.variance) / 2.0)  # of the true deviation, sqrt(PIECES)
        width.append(np.std(pair.utilities, ddof=1) / 2.0)
    assert 0.87 < np.mean(inside) < 0.97  # of 0.9
    assert np.quantile(least, 0.01) > 0.2 > 10 * np.quantile(width, 0.01)


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
        return standing(TASK, *self.both, self.options, PLANNER.fingerprint, PLANNER)


@pytest.fixture
def story():
    return Story()


def test_a_better_candidate_that_began_off_is_run_again_and_becomes_the_best(story):
    now = story.run(1, OFF)
    best, doubt = now.history
    assert doubt.utility < best.utility and doubt.gain_over(best) > 0
    assert (doubt.verdict(), doubt.to_settle) == ("in doubt", "c0002")
    assert (now.phase, now.outstanding.id, now.missing) == ("await-trial", "c0002", 1)
    assert losers_of(now.history, "c0001", PLANNER.fingerprint) == []
    now = story.run(0, OFF)  # what the best one measures then is no better
    now = story.run(1)
    assert now.incumbent.candidate.id == "c0002" and now.phase == "propose"
    assert now.incumbent.utility > now.history[0].utility


def test_a_start_behind_a_late_sensor_costs_as_much(story):
    policy = story.candidates[1].policy
    late = planner_of(TASK, [{"name": "sensor_delay:x", "d": 1.5 * TASK.dt}])
    assert late.plan.model.n > TASK.model.n
    plain, behind = (worth_of_start(planner, policy, OFF) for planner in (PLANNER, late))
    assert behind == pytest.approx(plain, rel=0.3) and behind < 0
