"""Standard deviations from the information: right where it is regular, honest where it is not."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from grounded import Model, Param, Trial, diagnose
from grounded.diagnosis.diagnose import DiagnosisOptions
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.intervals import standard_deviations
from grounded.diagnosis.validation.claims import moved_parameters
from grounded.effects import Library


def test_of_two_parameters_that_hide_each_other_one_stays():
    rng, trials = np.random.default_rng(1), []
    for _ in range(3):
        u, v = np.repeat(rng.uniform(-3, 3, 10), 8)[:, None], np.zeros(81)
        for k in range(80):
            v[k + 1] = v[k] + 0.05 * (1.3 * u[k, 0] - 0.8 * v[k] - 0.7 * v[k] ** 3)
        noisy = (v + 1e-3 * rng.standard_normal(81))[:, None]
        trials.append(Trial(noisy, u, 0.05, ("v",), ("u",), start_inputs=np.zeros(1)))
    boat = Model(
        states={"v": "m/s"},
        inputs={"u": "N"},
        params={"a": Param(0.5, std=0.3), "b": Param(0.5, std=0.3), "gain": Param(1.0, std=0.3)},
        derivative=lambda s, a, p: {"v": p.gain * a.u - p.a * s.v - p.b * s.v**3},
        integrator="euler",
    )
    search = HypothesisSearch(prepare(boat, trials), ())
    fit = search.nulls()
    without = SimpleNamespace(held_out=False)
    assert {*moved_parameters(search, fit, without)} == {0, 1, 2}

    def gain(less, whole):
        a, b, needed = np.abs(less.hypothesis.shift) > 1e-9
        return SimpleNamespace(mean=0.0 if needed and (a or b) else 1.0)

    ruler = SimpleNamespace(held_out=True, since_outset=lambda fit: 1.0, gain=gain)
    left = {*moved_parameters(search, fit, ruler)}
    assert 2 in left and len(left) == 2


def lagging(samples, late=0.05, grid=0.05, tau=0.1):
    """A motor's speed logged every `samples` [s], its commands sent every `grid` [s]."""
    rng, h = np.random.default_rng(0), 1e-3
    t = h * np.arange(30_000)
    sent = np.repeat(rng.uniform(-1, 1, 40), 750)
    acts = np.concatenate([np.zeros(round(late / h)), sent])[: len(t)]
    w = np.zeros(len(t) + 1)
    for k, u in enumerate(acts):
        w[k + 1] = u + (w[k] - u) * np.exp(-h / tau)
    at, when = np.arange(0, len(t), round(samples / h)), np.arange(0, len(t), round(grid / h))
    log = w[at] + 1e-3 * rng.standard_normal(len(at))
    return {"w": (t[at], log), "u": (t[when], sent[when])}


def test_a_delay_is_no_surer_than_states_between_two_samples(samples=0.02):
    """Of a rover's log at 50 Hz on a grid of 20 Hz: 0.0461 +- 0.0001 s, of 0.050 s."""
    from grounded_trials.logs.resample import to_grid
    from grounded_trials.logs.signals import Series, SignalSpec

    series = {}
    for name, (t, y) in lagging(samples).items():
        stamps = np.round(1e9 * t).astype(np.int64)
        spec = SignalSpec(f"/{name}.data")
        series[name] = Series(spec, stamps, y, stamps, len(t), "a/B")
    log = to_grid(series, 0.05, ["w"], ["u"])
    assert log.interpolated_s == pytest.approx(0.0025 if samples == 0.02 else 0.0, abs=1e-4)
    motor = Model(
        states={"w": "rad/s"},
        inputs={"u": "rad/s"},
        derivative=lambda s, a, p: {"w": (a.u - s.w) / 0.1},
    )
    trial = Trial(log.states, log.inputs, 0.05, ("w",), ("u",))
    found = diagnose(motor, [trial], DiagnosisOptions(interpolated_s=log.interpolated_s))
    (row,) = (one for one in found.ranking if one.claimed)
    d, least = row.params["d"], max(log.interpolated_s, 1e-5)
    assert row.effect == "sensor_delay:w" and abs(d.value - 0.05) < 2 * d.std
    assert least <= d.std < least + 1e-3


def test_values_are_no_surer_than_the_constant_that_was_tuned_beside_them():
    rng, trials, dt = np.random.default_rng(3), [], 0.01
    for _ in range(3):
        u = sum(a * np.sin(f * dt * np.arange(300)) for a, f in ((0.2, 9.0), (0.15, 23.0)))
        x = np.zeros((301, 2))
        for k in range(300):
            q, w = x[k]
            for _ in range(10):
                w += 0.1 * dt * (u[k] - 0.08 * np.clip(w / 0.3, -1, 1)) / 0.02
                q += 0.1 * dt * w
            x[k + 1] = q, w + 1e-3 * rng.standard_normal()
        log = x + rng.standard_normal(x.shape) * [1e-4, 3e-3]
        trials.append(Trial(log, u[:, None], dt, ("q", "w"), ("tau",), start_inputs=np.zeros(1)))
    model = Model(
        states={"q": "rad", "w": "rad/s"},
        inputs={"tau": "N m"},
        derivative=lambda s, a, p: {"q": s.w, "w": a.tau / 0.02},
    )
    data = prepare(model, trials)
    effect = Library().effect("joint_friction:tau<-w", model, data.scales)
    search = HypothesisSearch(data, (effect,))
    h = Hypothesis().plus(effect, {"c": 0.08, "b": 0.0, "width": 0.3})
    constant = replace(h, effects=(replace(h.effects[0], quantities=_untuned(h.effects[0])),))
    std = []
    for one in (constant, h):
        (fit,) = search.refined([search.fresh(one)], 20)
        std.append(standard_deviations(search.predictor, fit, data.trial_of)[0])
    assert len(std[0]) == len(std[1]) == len(h.theta)
    assert std[1][0] > 1.2 * std[0][0]


def _untuned(effect):
    return tuple(replace(q, tuned=False) for q in effect.quantities)
