"""Progress, Ctrl-C, workers and very many runs, in fit and diagnose."""

import sys
import time

import numpy as np
import pytest

from grounded import forked
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.engine import Engine, each, running
from grounded.fit import fit
from grounded.model import Model, Param
from grounded.progress import Interrupted, Stages
from stepped import logged, stepped


def lag(s, a, p):
    drive = np.where(a.u > p.dead, a.u, 0.0)
    return {"v": (p.gain * drive - s.v) / 0.3}


MODEL = Model(
    name="lag",
    states={"v": "m/s"},
    inputs={"u": "1"},
    params={"gain": Param(2.0, "m/s", 0.5, 5.0), "dead": Param(0.3, "1", 0.0, 0.8)},
    derivative=lag,
)


@pytest.fixture(scope="module")
def trials():
    rng, found = np.random.default_rng(3), []
    truth = MODEL.with_values({"gain": 2.4, "dead": 0.35})
    for low in (0.0, 0.6, 0.6, 0.6):  # only the first drives slowly: there the threshold acts
        u = np.repeat(rng.uniform(low, 1.0, (12, 1)), 10, axis=0)
        x = stepped(truth, u, 0.05, disturbed=np.array([0.005]), rng=rng)
        found.append(logged(truth, x, u, 0.05, 0.01, rng))
    return found


def test_all_runs_count_though_the_search_takes_only_some(trials, monkeypatch):
    whole = fit(MODEL, trials)
    monkeypatch.setattr(sys.modules["grounded.diagnosis.likelihood.data"], "MOST_NUMBERS", 900.0)
    monkeypatch.setattr(sys.modules["grounded.diagnosis.likelihood.data"], "SESSION", 2)
    stages = []
    few = fit(MODEL, trials, progress=stages.append)
    assert few.samples == whole.samples and any("all" in stage for stage in stages)
    for name, e in whole.params.items():
        assert few.params[name].value == pytest.approx(e.value, abs=e.std)
        assert few.params[name].std == pytest.approx(e.std, rel=0.3)


def test_each_stage_is_told_with_the_time_taken(monkeypatch):
    clock, told = [0.0], []
    monkeypatch.setattr("grounded.progress.time.monotonic", lambda: clock[0])
    stages = Stages(told.append, began=0.0)
    for name, clock[0] in (("scan", 2), ("refine", 150)):
        stages(name)
    assert told == ["scan, 2 s so far", "refine, 2.5 min so far"]


def test_ctrl_c_in_a_diagnosis_says_the_best_hypothesis_so_far(trials, after=25):
    count = 0

    def stop(stage):
        nonlocal count
        count += 1
        if count == after:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        diagnose(MODEL, trials, progress=stop)
    assert "confirmed" in str(stopped.value)


def test_ctrl_c_while_one_more_effect_is_sought_keeps_what_was_found(trials):
    whole = diagnose(MODEL, trials, DiagnosisOptions(max_effects=3))
    told = []

    def stop(stage):
        told.append(stage)
        if "one more effect; Ctrl-C keeps" in stage and "more effects" not in stage:
            raise KeyboardInterrupt

    found = diagnose(MODEL, trials, DiagnosisOptions(max_effects=5), progress=stop)
    assert found.effects == whole.effects and found.verdict.again
    assert "gap.more" in {one.code for one in found.findings}
    assert any(stage.startswith("more effects (one more effect; Ctrl-C") for stage in told)


def slowly(seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        sum(range(100))


def test_ctrl_c_ends_what_threads_are_at():
    began = time.monotonic()

    def stop():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), running(Engine(jobs=2), copied=False):
        each(slowly, [0.0, 60.0, 60.0], done=stop)
    assert time.monotonic() - began < 20.0


def test_a_fit_is_the_same_with_one_worker_and_with_three(trials, monkeypatch):
    monkeypatch.setattr(forked, "WORTH_S", 1e-9)
    monkeypatch.setattr(sys.modules["grounded.diagnosis.likelihood.refine"], "MOST_NUMBERS", 1.0)
    one, three = (fit(MODEL, trials, engine=Engine(n)) for n in (1, 3))
    assert one.to_json() == three.to_json() and one.loglik == three.loglik
