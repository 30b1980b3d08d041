"""Studies as jobs: any number of workers, kept results, lost workers."""

from pathlib import Path

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


def test_a_lost_worker_costs_its_job_only(tmp_path):
    marker = str(tmp_path / "died")
    jobs = [Job(experiment_jobs.dies_once, {"seed": s, "marker": marker}) for s in range(6)]
    assert run_jobs(jobs, Engine(jobs=2)) == [{"seed": s} for s in range(6)]
    assert Path(marker).exists()


@pytest.mark.slow
def test_workers_that_keep_dying_end_the_study_with_what_is_done():
    kept = {}
    jobs = [*draws(2), Job(experiment_jobs.dies_always, {"seed": 9})]
    with pytest.raises(GroundedError, match=holding("1 of 3", "--jobs")):
        run_jobs(jobs, Engine(jobs=2), finished=kept)
    assert set(kept) <= {job.key for job in jobs[:2]}


def test_no_workers_are_refused():
    with pytest.raises(GroundedError):
        Engine(0)
