"""A loss that different start states explain, by the model, is in doubt and ends no search."""

from dataclasses import replace

import numpy as np
import pytest

from grounded.plant import Plant
from grounded.search.difference import worth_of_start
from grounded.search.improve import propose
from grounded.search.planner import Planner
from grounded.search.standing import standing
from grounded.search.step_size import SearchOptions, losers_of
from grounded_trials.workspace.adopted import planner_of
from small_tasks import cart_task, drive, other

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
