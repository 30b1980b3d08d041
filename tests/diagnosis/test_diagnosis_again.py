"""After adoption, in its intervals, in its probe: a diagnosis says no more than the trials show."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.causes import meaning
from grounded.diagnosis.diagnose import DiagnosisOptions, diagnose
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.parts import Diagnosis, Estimate, Made, Ranked, Verdict
from grounded.effects import Library
from grounded.effects.actuator import delay_again
from grounded_trials.workspace.adoption import joined
from small_tasks import plain_task


def axis(gain):
    return Model(
        states={"x": "m", "v": "m/s"},
        inputs={"u": "1"},
        params={"gain": Param(gain, "m/s^2", 0.2, 5.0), "drag": Param(0.3, "1/s")},
        roles={"position": ("x",), "speed": "v"},
        derivative=lambda s, a, p: {"x": s.v, "v": p.gain * a.u - p.drag * s.v},
        name="axis",
    )


def runs(gain, trials=4, steps=200, wave=0.0, noise=1.0, alike=False):
    """Trials of an axis; `wave`: a force that is the same at the same time of each."""
    rng, found, model = np.random.default_rng(3), [], axis(gain)
    for _ in range(trials):
        t = np.arange(steps) * 0.05
        a, b = (1.0, 2.3) if alike else rng.uniform(0.7, 3, 2)
        u = 0.6 * np.sin(a * t) + 0.4 * np.sin(b * t)
        x, states = np.zeros(2), [np.zeros(2)]
        for time, value in zip(t, u, strict=True):
            pushed = np.array([[value + wave * np.sin(1.3 * time) ** 3]])
            x = model.system.step(x[None], pushed, model.values, 0.05)[0]
            states.append(x)
        y = np.array(states) + noise * np.array([1e-4, 5e-4]) * rng.standard_normal((steps + 1, 2))
        found.append(Trial(y, u[:, None], 0.05, ("x", "v"), ("u",), start_inputs=u[:1]))
    return found


def task(model, steps=200):
    return plain_task(model, 0.05, np.zeros((steps + 1, 2)), 1.0, 2.0)


@pytest.mark.slow
def test_after_adoption_what_is_too_little_to_matter_is_not_claimed():
    """A gain of 1.0 that is 1.5: adopted as 1.502, its last 0.13 % are above the noise."""
    trials = runs(1.5, trials=2, steps=120)
    few = Library(tuple(map(Library().family, ("input_gain", "viscous_friction", "delay"))))
    alone = diagnose(axis(1.502), trials, DiagnosisOptions(library=few))
    assert alone.effects  # seen, where nothing tells what the crude model missed
    found = diagnose(
        axis(1.502), trials, DiagnosisOptions(library=few, origin=task(axis(1.0), steps=120))
    )
    assert found.effects == () and not found.credit
    first = diagnose(
        axis(1.0), trials, DiagnosisOptions(library=few, origin=task(axis(1.0), steps=120))
    )
    assert first.effects
    (then, now) = ([r for r in d.prediction_error if not r.whole_trial][-1] for d in (first, found))
    assert now.outset == pytest.approx(then.crude, rel=0.05)  # one ruler, before and after
    assert alone.prediction_error[0].outset == {}
    assert {c.name: c.rms for c in found.where.channels} == now.crude


LATE = 0.1  # [s], two steps of an axis


def late_runs():
    """Trials of an axis whose commands arrive LATE."""
    return [
        replace(run, inputs=np.concatenate([run.inputs[2:], np.zeros((2, 1))])).until(198)
        for run in runs(1.0, trials=2)
    ]


@pytest.mark.parametrize("adopted", [0.095, 0.104])
def test_an_adopted_delay_is_made_longer_or_shorter(adopted):
    model = axis(1.0)
    data = prepare(model, late_runs(), np.array([adopted]))
    effect = delay_again(Library().effect("delay:u", model, data.scales), adopted, adopted)
    predictor, change = Predictor(data), LATE - adopted
    h = Hypothesis().plus(effect, {"d": change})
    whole = Predictor(replace(data, latency=np.array([LATE])))
    assert predictor.received(h) == pytest.approx(whole.received(Hypothesis()))
    assert min(effect.free[0].grid) < 0 < max(effect.free[0].grid)
    search = HypothesisSearch(data, [effect])
    assert search.price(effect, {"d": change}) < 10.0  # a tenth of a step is no matter of stamps
    search.nulls()
    search.extended(search.exact_null(), 1)
    (best,) = search.of_size(1)
    assert best.hypothesis.values[0]["d"] == pytest.approx(change, abs=5e-4)
    said = meaning(effect, {"d": Estimate(change, 1e-4, unit="s")})
    assert said.startswith("delay:u = 0.1") and ", was " in said


def test_adopting_a_change_of_a_delay_replaces_it():
    made = Made(adopted=({"name": "delay:u", "d": 0.104},))
    row = Ranked("delay:u", {"d": Estimate(-0.004)}, claimed=True)
    found = Diagnosis(Verdict("effect", ("delay:u",)), ranking=(row,), made=made)
    _, effects = joined(found, ["delay:u"], made.adopted, {}, {})
    assert effects == [{"name": "delay:u", "d": 0.1}]
