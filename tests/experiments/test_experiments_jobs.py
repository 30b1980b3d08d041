"""Studies as jobs: any number of workers, kept results, lost workers."""

import pytest

import experiment_jobs
from facts import holding
from grounded.engine import Engine
from grounded.errors import GroundedError
from grounded.experiments.jobs import run_jobs


def draws(count, sleep=0.0):
    return experiment_jobs.draw, [{"seed": seed, "sleep": sleep} for seed in range(count)]


def test_any_number_of_workers_gives_the_same_bits():
    alone = run_jobs(*draws(6))
    assert run_jobs(*draws(6), Engine(jobs=2)) == alone
    assert [result["seed"] for result in alone] == list(range(6))


@pytest.mark.slow
def test_a_lost_worker_ends_a_study(tmp_path):
    marker = str(tmp_path / "died")
    cases = [{"seed": s, "marker": marker} for s in range(6)]
    with pytest.raises(GroundedError, match=holding("of 6", "--jobs")):
        run_jobs(experiment_jobs.dies_once, cases, Engine(jobs=2))


def test_no_workers_are_refused():
    with pytest.raises(GroundedError):
        Engine(0)
