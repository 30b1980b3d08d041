"""Causes that robots have, simulated in small steps by other code, are found with their size."""

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import grounded as gr
from grounded import Model, Param, Trial
from grounded.effects import Library, SensorLagFamily, memory_start, wrap

DT, L, PARTS = 0.05, 0.3, 20


@dataclass(frozen=True)
class Truth:
    """What the real car has besides its model."""

    drag: float = 0.0
    grip: float = np.inf
    ahead: float = 0.0
    right: float = 1.0  # gain of steering to the right
    tau: float = 0.0
    under: float = 0.0
    late: int = 0  # control steps
    filtered: float = 0.0


def car_rates(s: Any, a: Any, p: Any) -> dict[str, Any]:
    turn = s.v / L * np.tan(a.steer)
    x, y = s.v * np.cos(s.psi), s.v * np.sin(s.psi)
    return {"x": x, "y": y, "psi": turn, "v": p.k * a.throttle - 0.8 * s.v}


def towed_rates(s: Any, a: Any, p: Any) -> dict[str, Any]:
    turn = a.speed / L * np.tan(a.steer)
    return {"x": a.speed * np.cos(s.psi), "y": a.speed * np.sin(s.psi), "psi": p.k / 3 * turn}


FREE = {"k": Param(3.0, "m/s^2", 1.0, 6.0)}
PLACE = {"x": "m", "y": "m", "psi": "rad"}
car = Model(
    name="car",
    states={**PLACE, "v": "m/s"},
    inputs={"steer": "rad", "throttle": "1"},
    params=FREE,
    angles=("psi",),
    derivative=car_rates,
)
towed = Model(
    name="towed",
    states=PLACE,
    inputs={"steer": "rad", "speed": "m/s"},
    params=FREE,
    angles=("psi",),
    derivative=towed_rates,
)


def driven(model: Model, truth: Truth, count: int = 4, steps: int = 120) -> list[Trial]:
    rng, found, h = np.random.default_rng(3), [], DT / PARTS
    for _ in range(count):
        t, w = DT * np.arange(steps), rng.uniform(0.8, 3.0, 3)
        steer = 0.35 * np.sign(np.sin(w[0] * t)) * np.abs(np.sin(w[0] * t)) ** 0.3
        power = 0.6 + 0.25 * np.sin(w[1] * t) + 0.1 * np.sign(np.sin(w[2] * t))
        u = np.stack([steer, power if model is car else 2.4 * power], axis=1)
        x, seen, got = np.array([0.0, 0.0, 0.0, 1.0]), 1.0, np.zeros(2)
        states = []
        for k in range(steps + 1):
            place = x[:2] + truth.ahead * np.array([np.cos(x[2]), np.sin(x[2])])
            states.append([*place, x[2], seen if truth.filtered else x[3]])
            wanted = u[max(min(k, steps - 1) - truth.late, 0)] if k >= truth.late else np.zeros(2)
            for _ in range(PARTS):
                got = got + (wanted - got) * (1 - np.exp(-h / truth.tau) if truth.tau else 1.0)
                delta = got[0] * (truth.right if got[0] < 0 else 1.0)
                v = x[3] if model is car else got[1]
                turn = v / L * np.tan(delta) / (1 + truth.under * v * v)
                turn = np.clip(turn, -truth.grip / abs(v), truth.grip / abs(v)) if v else 0.0
                slower = 3.0 * got[1] - 0.8 * v - truth.drag * abs(delta) * v
                mid = x[2] + 0.5 * h * turn
                x = x + h * np.array([v * np.cos(mid), v * np.sin(mid), turn, slower])
                seen += (x[3] - seen) * h / truth.filtered if truth.filtered else 0.0
            x = x + np.array([1e-3, 1e-3, 2e-3, 3e-3]) * rng.standard_normal(4)
        noise = np.array([2e-3, 2e-3, 4e-3, 8e-3]) * rng.standard_normal((steps + 1, 4))
        y = (np.array(states) + noise)[:, : model.n]
        names = (model.state_names, model.input_names)
        found.append(Trial(y, u, DT, *names, start_inputs=np.zeros(2)))
    return found


CASES = [
    (car, Truth(drag=2.0), "cornering_drag:v<-steer", {"k": 2.0}),
    (car, Truth(grip=2.5), "grip_limit:psi", {"a": 2.5}),
    (car, Truth(ahead=0.12), "lever_arm:x+y", {"a": 0.12, "b": 0.0}),
    (towed, Truth(under=0.1), "understeer:psi", {"k": 0.1}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("model", "truth", "effect", "values"), CASES, ids=lambda c: str(c)[:40])
def test_the_cause_is_found_with_its_size(model, truth, effect, values):
    found = gr.diagnose(model, driven(model, truth, count=3))
    assert found.ranking[0].effect == effect and found.ranking[0].claimed
    for name, value in values.items():
        assert found.ranking[0].params[name].value == pytest.approx(value, rel=0.1, abs=0.02)


boat = Model(
    name="boat",
    states={"v": "m/s", "r": "rad/s", "psi": "rad"},
    inputs={"left": "1", "right": "1"},
    params={"k": Param(1.0, "m/s^2", 0.2, 4.0), "arm": Param(1.5, "1/m", 0.3, 6.0)},
    angles=("psi",),
    derivative=lambda s, a, p: {
        "v": p.k * (a.left + a.right) - 0.6 * s.v,
        "r": p.k * p.arm * (a.right - a.left) - 1.1 * s.r,
        "psi": s.r,
    },
)


@pytest.mark.slow
def test_thrusters_that_are_weaker_astern_are_named_together():
    rng, astern, trials = np.random.default_rng(5), 0.6, []
    for _ in range(3):
        sent = np.repeat(rng.uniform(-0.9, 0.9, (20, 2)), 8, axis=0)
        got, x = np.where(sent < 0, astern, 1.0) * sent, [np.zeros(3)]
        for u in got:
            after = boat.system.step(x[-1][None], u[None], boat.values, DT)[0]
            x.append(after + 1e-3 * rng.standard_normal(3))
        seen = np.array(x) + 4e-3 * rng.standard_normal((len(x), 3))
        trials.append(Trial(seen, sent, DT, boat.state_names, boat.input_names))
    found = gr.diagnose(boat, trials)
    assert found.effects[0] == "input_curve:left+right"
    assert not any(name.startswith(("offset", "input_bias")) for name in found.effects)
    ahead = found.ranking[0].params["a"]  # beside a gain
    assert ahead.value == pytest.approx((1 - astern) / (1 + astern), abs=4 * ahead.std)


def test_an_adopted_sensor_lag_is_a_filter():
    effect = Library().effect("sensor_lag:v", car)
    assert isinstance(effect.family, SensorLagFamily)
    model = wrap(effect, {"tau": 0.2}, DT)
    one = driven(car, Truth(), count=1, steps=40)[0]
    z = [np.hstack([one.states[0], memory_start(model, car, one)])]
    for u in one.inputs:
        z.append(model.system.step(z[-1][None], u[None], model.values, DT)[0])
    true, logged = np.array(z)[:, 4], np.array(z)[:, 3]
    filtered, fine = [true[0]], true[0]
    for before, after in itertools.pairwise(true):
        for k in range(200):
            now = before + (after - before) * (k + 0.5) / 200
            fine += (now - fine) * DT / 200 / 0.2
        filtered.append(fine)
    np.testing.assert_allclose(logged, filtered, atol=2e-3 * np.ptp(true))
    assert np.abs(logged - true).max() > 0.02
