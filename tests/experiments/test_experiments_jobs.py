"""Studies as jobs: any number of workers, kept results, lost workers."""

import pytest

import experiment_jobs
from facts import holding
from grounded.engine import Engine
from grounded.errors import GroundedError
from grounded.experiments.jobs import Job, run_jobs


def draws(count, sleep=0.0):
    return [Job(experiment_jobs.draw, {"seed": seed, "sleep": sleep}) for seed in range(count)]


def test_any_number_of_workers_gives_the_same_bits():
    alone = run_jobs(draws(6))
    assert run_jobs(draws(6), Engine(jobs=2)) == alone
    assert [result["seed"] for result in alone] == list(range(6))


def test_finished_jobs_are_kept_and_not_run_again():
    kept = {}
    first = run_jobs(draws(3), finished=kept)
    assert len(kept) == 3
    kept[draws(1)[0].key] = {"seed": 0, "value": "kept"}
    seen = []
    again = run_jobs(
        draws(5), finished=kept, progress=lambda done, total: seen.append((done, total))
    )
    assert again[0] == {"seed": 0, "value": "kept"}
    assert again[1:3] == first[1:]
    assert seen == [(3, 5), (4, 5), (5, 5)]


@pytest.mark.slow
def test_a_lost_worker_ends_a_study_that_goes_on_from_what_is_finished(tmp_path):
    jobs = [
        Job(experiment_jobs.dies_once, {"seed": s, "marker": str(tmp_path / "died")})
        for s in range(6)
    ]
    kept = {}
    with pytest.raises(GroundedError, match=holding("of 6", "--jobs")):
        run_jobs(jobs, Engine(jobs=2), finished=kept)
    assert run_jobs(jobs, Engine(jobs=2), finished=kept) == [{"seed": s} for s in range(6)]


def test_no_workers_are_refused():
    with pytest.raises(GroundedError):
        Engine(0)
