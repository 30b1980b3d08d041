"""What third-party simulators showed: starts, rival plans, limit cycles, endings, repeats."""

import importlib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from grounded.plant import Plant
from grounded.search import making
from grounded.search.ask_tell import Search
from grounded.search.first_guess import filled_target
from grounded.search.first_policy import first_policy
from grounded.solve import ddp
from small_tasks import cart_task, drive, other


@pytest.fixture
def mechanisms(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2]))
    return importlib.import_module("benchmarks.foreign.mechanisms")


@pytest.fixture
def late_arm(mechanisms):
    """An arm with a command delay of 30 ms: high gains cause a limit cycle."""
    task = mechanisms.arm_task()
    plant = Plant(task.model, latency=dict.fromkeys(task.model.input_names, 0.03), substeps=10)
    return SimpleNamespace(task=task, run=lambda candidate: drive(task, plant, candidate))


@pytest.mark.slow
def test_the_first_plan_is_finished_and_the_best_of_many_starts(mechanisms):
    """Reason 2: 0.1 stopped this swing-up after 100 iterations, unconverged, at -431."""
    task = mechanisms.cart_task("smooth")
    _, plan = first_policy(task)
    assert plan.status == "converged"
    assert plan.cost < 84.0  # only found by a plan to be upright early; others give 91.9
    held = ddp.solve(task.problem(), np.tile(task.past, (task.horizon, 1)))
    assert plan.cost < 0.9 * held.cost  # an optimum that the held input does not lead to


def test_only_columns_that_are_weighed_shape_the_guess(mechanisms):
    task = mechanisms.arm_task()
    wild = np.array(task.target)
    wild[:, 2:] = np.random.default_rng(0).normal(size=wild[:, 2:].shape) * 50.0
    for found, expected in zip(
        filled_target(replace(task, target=wild)), filled_target(task), strict=True
    ):
        np.testing.assert_array_equal(found, expected)


def test_an_unstable_loop_gets_gentler_gains(late_arm):
    search = Search(late_arm.task)
    search.tell(late_arm.run(search.ask()))
    wild = search.best.utility
    assert search.standing.then.verb == "diagnose"  # at once
    gentle = search.ask()
    assert gentle.way == "gentler gains" and gentle.base == "c0001"
    first = search.candidates[0].policy
    assert np.abs(gentle.policy.gain).max() < 0.2 * np.abs(first.gain).max()
    search.tell(late_arm.run(gentle))
    after = search.ask()
    assert after.caution == gentle.caution  # the steps from it stay gentle
    search.tell(late_arm.run(after))
    assert wild < -1e3 and search.best.utility > -2.0


@pytest.mark.parametrize(
    ("gain", "ending"), [(np.nan, "model diverges"), (-1e6, "every step loses")]
)
def test_an_end_says_what_it_is(monkeypatch, gain, ending):
    """Reason 5: 0.1 called both converged, "the model promises less than 0.1 %"."""
    made = making.Maker.candidate
    monkeypatch.setattr(
        making.Maker, "candidate", lambda *a, **k: replace(made(*a, **k), predicted_gain=gain)
    )
    task = cart_task()
    real = Plant(other(task.model))
    search = Search(task)
    search.tell(drive(task, real, search.ask()))
    assert search.ask() is None
    assert (search.standing.phase, search.standing.ending) == ("stopped", ending)
    assert search.standing.then.verb == "diagnose"
