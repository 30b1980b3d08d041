"""Studies as jobs: any number of workers, kept results, lost workers, a Dask cluster."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import experiment_jobs
from facts import holding
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.effects import Library
from grounded.engine import Engine
from grounded.errors import GroundedError
from grounded.experiments.jobs import Job, run_jobs
from grounded.fit import fit
from grounded.trial import Trial
from grounded_trials.workspace.user_files.model_file import load_module
from shared_data import SUPPORT

pytest.importorskip("joblib", reason="joblib is not installed")


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


def test_a_worker_with_another_version_is_refused(monkeypatch):
    monkeypatch.setattr("grounded.experiments.jobs.code", lambda: "another")
    with pytest.raises(GroundedError, match=holding("version", "grounded")):
        run_jobs(draws(2), Engine(jobs=2))


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


def test_engines_that_make_no_sense_are_refused():
    for wrong in ({"jobs": 0}, {"name": "slurm"}, {"name": "dask"}, {"address": "tcp://x:1"}):
        with pytest.raises(GroundedError):
            Engine(**wrong)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler and two worker processes of their own: (address, workers)."""
    tmp_path = tmp_path_factory.mktemp("cluster")
    pytest.importorskip("distributed", reason='dask is not installed: pip install ".[cluster]"')
    path = [str(SUPPORT), os.environ.get("PYTHONPATH", "")]
    env = os.environ | {"PYTHONPATH": os.pathsep.join(path), "OPENBLAS_NUM_THREADS": "1"}

    def start(module, *arguments):
        command = [sys.executable, "-m", f"distributed.cli.{module}", *arguments]
        log = (tmp_path / f"{module}{len(started)}.log").open("w")
        started.append(subprocess.Popen(command, cwd=tmp_path, env=env, stdout=log, stderr=log))

    started = []
    try:
        start("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        log = tmp_path / "dask_scheduler0.log"
        address = _wait_for(lambda: _address(log.read_text()))
        for _ in range(2):
            start("dask_worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
        yield address, started[1:]
    finally:
        for process in reversed(started):
            process.terminate()
            process.wait(20)


def _wait_for(condition, seconds=60):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        if found := condition():
            return found
        time.sleep(0.1)
    raise TimeoutError


def _address(text):
    found = re.search(r"Scheduler at:\s*(tcp://[\d.:]+)", text)
    return found.group(1) if found else None


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_no_cluster_is_said_so(monkeypatch):
    pytest.importorskip("distributed", reason="dask is not installed")
    monkeypatch.setattr("grounded.engine.CONNECT_S", 1.0)
    with pytest.raises(GroundedError, match=holding("tcp://127.0.0.1:9")):
        run_jobs(draws(1), Engine(name="dask", address="tcp://127.0.0.1:9"))


LAG = """
import numpy as np
from grounded import Model, Param

LIMIT = 0.1


def rate(s, a, p):
    return {"v": (p.gain * np.where(np.abs(a.u) > LIMIT, a.u, 0.0) - s.v) / p.tau}


model = Model(
    states={"v": "m/s"},
    inputs={"u": "1"},
    params={"gain": Param(2.0, "m/s", 0.5, 5.0), "tau": Param(0.3, "s", 0.05, 2.0)},
    derivative=rate,
)
"""


def runs_of(model, count, steps):
    """Trials of a model whose gain is another, its input a step late."""
    rng, found = np.random.default_rng(3), []
    truth = model.with_values({"gain": 2.4})
    for _ in range(count):
        u = np.clip(np.cumsum(rng.normal(0, 0.2, (steps, 1)), axis=0), -1.0, 1.0)
        x = np.zeros((steps + 1, 1))
        for t in range(steps):
            late = u[max(t - 1, 0)][None]
            x[t + 1] = truth.system.step(x[t : t + 1], late, truth.values, 0.05)[0]
        x += 0.01 * rng.standard_normal(x.shape)
        found.append(Trial(dt=0.05, states=x, inputs=u, state_names=("v",), input_names=("u",)))
    return found


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Dask and tornado, about themselves
def test_a_fit_and_a_diagnosis_on_a_cluster_give_the_same_bits(cluster, tmp_path, monkeypatch):
    (tmp_path / "lag.py").write_text(LAG)  # as in a workspace: no worker can import it
    model = load_module(tmp_path, "lag.py").model
    trials, engine = runs_of(model, 6, 60), Engine(name="dask", address=cluster[0])
    blocks = sys.modules["grounded.diagnosis.likelihood.refine"]
    monkeypatch.setattr(blocks, "MOST_NUMBERS", 1.0)
    one, many = (fit(model, trials, engine=e) for e in (None, engine))
    assert one.to_json() == many.to_json() and one.loglik == many.loglik
    assert one.params["gain"].value == pytest.approx(2.4, abs=0.1)
    some = ("dead_zone", "delay", "offset")
    library = Library(tuple(one for one in Library().families if one.name in some))
    short = DiagnosisOptions(library, max_effects=1)
    one, many = (diagnose(model, trials[:2], short, engine=e).to_json() for e in (None, engine))
    assert one == many and one["verdict"]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of Dask and tornado, about themselves
def test_a_cluster_that_loses_a_worker_half_way_gives_the_same_bits(cluster):
    address, workers = cluster
    jobs = draws(12, sleep=0.3)

    def kill_one_half_way(done, total):
        if done == 5:
            workers[0].kill()

    engine = Engine(name="dask", address=address)
    found = run_jobs(jobs, engine, progress=kill_one_half_way)
    assert workers[0].wait(20) != 0
    assert found == run_jobs(jobs)
