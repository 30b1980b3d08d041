"""What moves or pushes a vehicle over ground: a current and a push, in the axes of the ground."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import sensitivities_of, step_jacobian
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Effect, Library, scales_of, wrap, wrapping_order
from grounded.search.planner import planner_with
from small_tasks import plain_task
from stepped import logged, slopes, stepped

DT = 0.1
CURRENT = ("current:u+v", {"a": 0.15, "b": -0.08})
PUSH = ("push_world:u+v", {"a": 0.15, "b": -0.08})
DRAG = ("quadratic_drag:u", {"k": 0.3})


def rates(
    s: Any, a: Any, p: Any, water=(0.0, 0.0), push=(0.0, 0.0), added=(0.0, 0.0, 0.0)
) -> dict[str, Any]:
    """A boat over ground; of its drag only the velocity through the water makes one. added."""
    cos, sin = np.cos(s["psi"]), np.sin(s["psi"])
    ahead = s["u"] - water[0] * cos - water[1] * sin
    aside = s["v"] + water[0] * sin - water[1] * cos
    X = push[0] * cos + push[1] * sin
    Y = push[1] * cos - push[0] * sin
    drag = p["X"] * ahead + p["XX"] * ahead * np.abs(ahead)
    return {
        "u": a["thrust"] - drag + X + (1 + added[0]) * s["v"] * s["r"],
        "v": -p["Y"] * aside + Y - (1 - added[1]) * s["u"] * s["r"],
        "r": a["rudder"] - 1.8 * s["r"] + added[2] * s["u"] * s["v"],
        "x": s["u"] * cos - s["v"] * sin,
        "y": s["u"] * sin + s["v"] * cos,
        "psi": s["r"],
    }


STATES = {"u": "m/s", "v": "m/s", "r": "rad/s", "x": "m", "y": "m", "psi": "rad"}
INPUTS = {"thrust": "m/s^2", "rudder": "rad/s^2"}
SIZES = {"X": 0.4, "XX": 0.3, "Y": 2.0}


def boat_of(*, states=STATES, uncertain=True, **sizes: float) -> Model:
    params = {n: Param(v, "1/s", 0.0, 5.0) if uncertain else Param(v) for n, v in sizes.items()}
    return Model(
        name="boat",
        states=states,
        inputs=INPUTS,
        params=params,
        angles=("psi",),
        derivative=rates,
    )


boat = boat_of(**SIZES)


def driven(count=3, steps=150, **truth: tuple[float, ...]) -> list[Trial]:
    """Trials of the real boat, in fine steps of other code, with noise."""

    def moved(x: Any, u: Any) -> Any:
        s, a = dict(zip(STATES, x, strict=True)), dict(zip(INPUTS, u, strict=True))
        return np.array(list(rates(s, a, SIZES, **truth).values()))

    rng, found, t = np.random.default_rng(5), [], DT * np.arange(steps)
    disturbed = np.array([4e-3, 4e-3, 4e-3, 0, 0, 0])
    for _ in range(count):
        w = rng.uniform(0.3, 1.2, 3)
        thrust = 0.5 + 0.3 * np.sign(np.sin(w[0] * t + 1))
        u = np.stack([thrust, 0.8 * np.sign(np.sin(w[1] * t)) * np.abs(np.sin(w[2] * t))], axis=1)
        x = stepped(moved, u, DT, np.zeros(6), disturbed=disturbed, rng=rng)
        found.append(logged(boat, x, u, DT, [0.01, 0.01, 6e-3, 0.01, 0.01, 4e-3], rng))
    return found


TRIALS = driven()


def effect(name: str, model: Model = boat) -> Effect:
    one = TRIALS[0]
    scales = scales_of(model, one.states, one.inputs, DT, one.steps * DT)
    return Library().effect(name, model, scales)


def hypothesis(*parts: tuple[str, dict[str, float]], model: Model = boat) -> Hypothesis:
    h = Hypothesis()
    for name, values in parts:
        h = h.plus(effect(name, model), values)
    return h


def adopted(*parts: tuple[str, dict[str, float]], model: Model = boat) -> Model:
    """The model that plans with these effects."""
    task = plain_task(model, DT, np.zeros((11, model.n)), 1.0, 1.0, terminal=1.0, effort=1.0)
    return planner_with(task, parts).plan.model


@pytest.mark.parametrize(
    ("parts", "truth"),
    [
        ((CURRENT,), {"water": (0.15, -0.08)}),
        ((PUSH,), {"push": (0.15, -0.08)}),
    ],
    ids=["current", "push_world"],
)
def test_the_adopted_model_is_the_boat_in_the_water(parts, truth):
    """Linear and quadratic drag, ahead and aside: one current, exactly."""
    model = adopted(*parts)
    assert model.system.how == "compiled", model.system.note

    def real(s: Any, a: Any, p: Any) -> dict[str, Any]:
        return rates(s, a, p, **truth)

    want = Model(states=STATES, inputs=INPUTS, params=boat.params, angles=("psi",), derivative=real)
    x, u = TRIALS[0].states[:-1], TRIALS[0].inputs
    found = model.system.step(x, u, model.values, 0.02)
    np.testing.assert_allclose(found, want.system.step(x, u, want.values, 0.02), atol=3e-6)


TOGETHER = [(CURRENT,), (PUSH, CURRENT, DRAG)]


@pytest.mark.parametrize("parts", TOGETHER, ids=lambda p: "+".join(n.split(":")[0] for n, _ in p))
def test_an_adopted_medium_is_the_one_that_was_diagnosed(parts):
    data, h = prepare(boat, TRIALS[:1]), hypothesis(*parts)
    want = Predictor(data).next(h, data.y[:-1])
    order = wrapping_order([e.family for e in h.effects])
    model = adopted(*(parts[i] for i in order))  # as `adopt` writes them
    x, u = data.y[:-1].reshape(-1, 6), Predictor(data).inputs(h).reshape(-1, 2)
    found = model.system.step(x, u, model.values, DT)
    np.testing.assert_allclose(found.reshape(want.shape), want, atol=1e-9)


@pytest.mark.parametrize("parts", TOGETHER, ids=lambda p: "+".join(n.split(":")[0] for n, _ in p))
def test_its_slopes_are_those_of_its_steps(parts):
    """A current's exactly; where a rate's kick moves the model, to two per cent, as of any rate."""
    data = prepare(boat, TRIALS[:1])
    predictor, h = Predictor(data), hypothesis(*parts)
    x, u = data.y[:-1], predictor.inputs(h)
    F = step_jacobian(predictor, h, data.y)
    both, by_param = sensitivities_of(predictor, h, x, u)
    np.testing.assert_allclose(both, F, atol=1e-12)
    of_states = slopes(lambda at: predictor.advance(h, at, u, data.time), x)
    of_params = slopes(
        lambda shift: predictor.advance(replace(h, shift=shift), x, u, data.time), np.zeros(3)
    )
    for found, expected in ((F, of_states), (by_param, of_params)):
        error = np.quantile(np.abs(found - expected).max(axis=-2), 0.9, axis=(0, 1))
        assert (error < (1e-6 if parts == (CURRENT,) else 0.02)).all()


def test_a_drag_that_joins_a_model_with_a_current_acts_through_the_water():
    model = adopted(CURRENT)
    data, h = prepare(model, TRIALS[:1]), hypothesis(DRAG, model=model)
    found = Predictor(data).next(h, data.y[:-1])
    x, u = data.y[:-1].reshape(-1, 6), Predictor(data).inputs(h).reshape(-1, 2)
    for both in (adopted(CURRENT, DRAG), adopted(DRAG, CURRENT), joined(DRAG, model)):
        want = both.system.step(x, u, both.values, DT)
        np.testing.assert_allclose(found.reshape(want.shape), want, atol=1e-9)


def joined(part: tuple[str, dict[str, float]], model: Model) -> Model:
    """The model with one more effect."""
    name, values = part
    return wrap(Library().effect(name, model), values, DT)
