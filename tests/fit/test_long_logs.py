"""Thresholds on the records they act on, progress, and Ctrl-C, in fit and diagnose."""

import re
import sys
from dataclasses import replace

import numpy as np
import pytest

from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.writer import Writer
from grounded.engine import Engine
from grounded.estimate import NoiseStd, of_states, record_of
from grounded.fit import fit
from grounded.fit.point import fall, point
from grounded.fit.search import data_of
from grounded.fit.unknowns import unknowns_of
from grounded.model import Model, Param
from grounded.progress import Interrupted, Stages
from grounded.trial import Trial


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
NOISE = NoiseStd(np.array([0.005]), np.array([0.01]), 0.05)


@pytest.fixture(scope="module")
def trials():
    rng, found = np.random.default_rng(3), []
    truth = MODEL.with_values({"gain": 2.4, "dead": 0.35})
    for low in (0.0, 0.6, 0.6, 0.6):  # only the first drives slowly: there the threshold acts
        u = np.repeat(rng.uniform(low, 1.0, (12, 1)), 10, axis=0)
        x = np.zeros((len(u) + 1, 1))
        for t, command in enumerate(u):
            x[t + 1] = truth.system.step(x[t : t + 1], command[None], truth.values, 0.05)[0]
            x[t + 1] += 0.005 * rng.standard_normal()
        y = x + 0.01 * rng.standard_normal(x.shape)
        found.append(Trial(dt=0.05, states=y, inputs=u, state_names=("v",), input_names=("u",)))
    return found


def test_a_threshold_is_worth_the_same_on_the_records_it_acts_on(trials):
    records = [record_of(MODEL, trial) for trial in trials]
    unknowns = unknowns_of(MODEL, None, np.zeros(1), "known")
    data = data_of(MODEL, records, of_states(MODEL), unknowns)
    at = point(data, NOISE, np.array([2.4, 0.35]))
    for value in (0.1, 0.3, 0.36, 0.5):
        there = point(data, NOISE, np.array([2.4, value]))
        assert fall(data, at, 1, value) == pytest.approx(
            at.loglik - there.loglik, abs=0.02, rel=1e-4
        )
    batch = data.batch(at.theta)
    assert data.batch(at.theta) is batch and batch.count == at.count
    assert replace(data, records=data.records[:1]).batch(at.theta).count < at.count


def clocked(monkeypatch, most, calls, exponent):
    """What is told at each call, and the time that was left then [s]."""
    clock, told = [0.0], []
    monkeypatch.setattr("grounded.progress.time.monotonic", lambda: clock[0])
    stages = Stages(told.append, most=most, began=0.0)
    times = [240 * (k / calls) ** exponent for k in range(1, calls + 1)]
    for clock[0] in times:
        stages("refine")
    return told, [times[-1] - at for at in times]


@pytest.mark.parametrize("calls", [60, 200, 390])
@pytest.mark.parametrize("exponent", [0.9, 1.0, 1.1])
def test_no_more_time_is_left_than_is_told(monkeypatch, calls, exponent):
    """A diagnosis had `at most 45 s left`, and took three minutes more. `8 s to 8 min` is none."""
    told, left = clocked(monkeypatch, 400, calls, exponent)
    inside = []
    for text, true in zip(told, left, strict=True):
        ends = [float(n) * {"s": 1, "min": 60}[u] for n, u in re.findall(r"([\d.]+) (s|min)", text)]
        assert text.startswith("refine, ") and "at most" not in text
        if text.endswith("left"):
            assert " up to about " in text and len(ends) == 2
            inside.append(true <= ends[1] * 1.3 + 30)  # whole minutes
    assert len(inside) == len(told) - 10 and sum(inside) > 0.9 * len(inside)


def test_of_what_takes_more_calls_than_most_no_end_is_told(monkeypatch):
    """`up to about 10 s left`, and then 4 minutes `longer than usual`."""
    told, _ = clocked(monkeypatch, 20, 30, 1.3)
    assert not any("left" in text for text in told[:10]) and "left" in told[12]
    assert not any("left" in text for text in told[20:])
    assert told[-1] == "refine, 4.0 min so far"


@pytest.mark.parametrize("after", [3, 25])
def test_ctrl_c_in_a_diagnosis_says_the_best_hypothesis_so_far(trials, after):
    count = 0

    def stop(stage):
        nonlocal count
        count += 1
        if count == after:
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as stopped:
        diagnose(MODEL, trials, progress=stop)
    assert "hypothes" in str(stopped.value)
    if after == 25:
        assert "no diagnosis is stored" in str(stopped.value)
        told = r"Predictions \S+ s ahead miss v by \S+ instead of \S+ m/s"
        assert re.search(told, str(stopped.value))


def test_ctrl_c_while_one_more_effect_is_sought_keeps_what_was_found(trials, monkeypatch):
    """After 18 minutes, five effects were confirmed, all true, and nothing was stored."""
    monkeypatch.setattr(Writer, "unfinished", property(lambda writer: True))
    whole = diagnose(MODEL, trials, DiagnosisOptions(max_effects=3)).verdict
    told = []

    def stop(stage):
        told.append(stage)
        if "one more effect; Ctrl-C keeps" in stage and "more effects" not in stage:
            raise KeyboardInterrupt

    found = diagnose(MODEL, trials, progress=stop).verdict
    assert found.effects == whole.effects and found.again
    assert found.lines[:-1] == whole.lines and "Interrupted" in found.lines[-1]
    assert any(stage.startswith("more effects (one more effect; Ctrl-C") for stage in told)


def test_ctrl_c_in_a_fit_says_the_values_so_far(trials):
    def stop(stage):
        if stage.startswith("fit"):
            raise KeyboardInterrupt

    with pytest.raises(Interrupted, match=r"gain = .* m/s"):
        fit(MODEL, trials, progress=stop)


@pytest.mark.slow
def test_a_diagnosis_is_the_same_on_one_thread_and_on_two(trials):
    one, two = (diagnose(MODEL, trials, engine=Engine(n)).to_json() for n in (1, 2))
    assert one == two


def test_a_fit_is_the_same_on_one_thread_and_on_three(trials, monkeypatch):
    parts = sys.modules["grounded.fit.point"]
    monkeypatch.setattr(parts, "PART", 2)
    monkeypatch.setattr(parts, "SMALL", 0)
    one, three = (fit(MODEL, trials, engine=Engine(n)) for n in (1, 3))
    assert one.to_json() == three.to_json() and one.loglik == three.loglik
    assert np.array_equal(one.covariance, three.covariance)
    monkeypatch.setattr(parts, "SMALL", 1_000_000)
    whole = fit(MODEL, trials)
    for name, value in whole.params.items():
        assert one.params[name].value == pytest.approx(value.value, abs=0.1 * value.std)
        assert one.params[name].std == pytest.approx(value.std, rel=0.05)
