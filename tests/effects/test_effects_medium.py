"""What acts along a motion: currents and pushes over ground, what joints take off their input."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from grounded import Model, Param, Trial
from grounded.compile import Named
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import sensitivities_of, step_jacobian
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Effect, Library, scales_of, wrap, wrapping_order
from grounded.effects.joint import FAMILIES, pairs_of
from grounded.effects.losses import dry
from grounded.models.aircraft import model as aircraft
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum
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


STEP = 0.02


def mass(s: Any, a: Any, p: Any) -> tuple[Any, Any, Any]:
    """Inertia matrix of two uniform rods, by its three numbers."""
    h = 0.5 * p.m2 * 0.2 * np.cos(s.q2)
    second = p.m2 * 0.04 + 0.0133
    return 0.125 + 0.25 * p.m2 + second + 2 * h, second + h, second


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    m11, m12, m22 = mass(s, a, p)
    h = 0.1 * p.m2 * np.sin(s.q2)
    r1 = a.t1 + h * (2 * s.w1 * s.w2 + s.w2**2)
    r2 = a.t2 - h * s.w1**2
    det = m11 * m22 - m12**2
    return {
        "q1": s.w1,
        "q2": s.w2,
        "w1": (m22 * r1 - m12 * r2) / det,
        "w2": (m11 * r2 - m12 * r1) / det,
    }


arm = Model(
    name="arm",
    states={"q1": "rad", "q2": "rad", "w1": "rad/s", "w2": "rad/s"},
    inputs={"t1": "N m", "t2": "N m"},
    params={"m2": Param(1.0, "kg", 0.3, 3.0)},
    derivative=dynamics,
)
PAIRS = ["t1<-w1", "t2<-w2"]
SPRINGS = ["t1<-q1", "t2<-q2"]


def arm_rates(x, u, c, J, k=(0.0, 0.0)):
    """ds/dt of the real arm: friction and springs in its joints, inertia on their axes."""
    p, s = Named("parameter", ("m2",), [1.0]), Named("state", arm.state_names, x)
    left = u - np.array(c) * np.tanh(x[2:] / 2e-3) - np.array(k) * x[:2]
    own = dynamics(s, Named("input", arm.input_names, left), p)
    m11, m12, m22 = mass(s, None, p)
    M = np.array([[m11, m12], [m12, m22]])
    return np.concatenate([x[2:], np.linalg.solve(M + np.diag(J), M @ [own["w1"], own["w2"]])])


def real_trials(count=3, steps=100, c=(0.0, 0.0), J=(0.0, 0.0), k=(0.0, 0.0)):
    """Logs of the arm with friction and springs in its joints, in fine steps, with noise."""
    rng, found, t = np.random.default_rng(1), [], STEP * np.arange(steps)
    for _ in range(count):
        w = rng.uniform(2, 7, 4)
        u = np.stack([1.5 * np.sin(w[0] * t) + np.sin(w[1] * t), 0.4 * np.sin(w[2] * t)], 1)
        u[:, 1] += 0.3 * np.sin(w[3] * t)
        x = stepped(
            lambda x, u: arm_rates(x, u, c, J, k), u, STEP, np.zeros(4),
            disturbed=np.array([0, 0, 2e-3, 4e-3]), rng=rng,
        )  # fmt: skip
        found.append(logged(arm, x, u, STEP, [5e-4, 5e-4, 1e-2, 1e-2], rng))
    return found


@pytest.mark.parametrize("w", [-0.3, 0.02, 0.6])
@pytest.mark.parametrize("free", [-0.4, 0.05, 2.0])
def test_dry_friction_over_a_step_is_that_of_many_small_ones(w, free):
    """Slides, stands, turns round; c / width is far too stiff for the step."""
    gain, c, b, width, x, N = 0.5, 0.5, 0.2, 1e-3, w, 20_000
    for _ in range(N):
        push = x + (free - w) / N - gain * b * x / N
        x = np.sign(push) * max(abs(push) - gain * c / N, 0.0)
    end = free - gain * dry(w, free, gain, c, b, width)
    assert end == pytest.approx(x, abs=gain * c / 2 + 1.5 * width)
    if w * x > 0 or w == 0:  # it does not turn round
        assert end == pytest.approx(x, abs=5e-3 + 1.5 * width)


@pytest.mark.parametrize("family", FAMILIES, ids=lambda family: family.name)
@pytest.mark.parametrize(("w", "rate", "u"), [(1.0, -3.0, 2.0), (1.0, 5.0, -1.0), (-2.0, 4.0, 0.0)])
def test_a_loss_at_one_moment_is_that_of_a_short_step(family, w, rate, u):
    """The challenge's truth has the one, the diagnosis the other."""
    values, gain, dt = {"c": 0.3, "b": 0.1, "width": 0.02, "k": 0.2, "J": 0.05}, 2.0, 1e-7
    mean = family.loss(w, w + dt * rate, dt * gain, u, values, dt)
    moment = family.torque(w, rate, gain, u, values)
    if family.name == "added_inertia":  # the step is solved for the rate that it leaves
        moment /= 1 + gain * values["J"]
    assert mean == pytest.approx(moment, rel=1e-4) and abs(mean) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("family", ["load_friction", "joint_spring"])
def test_an_adopted_loss_is_the_one_that_was_diagnosed(family):
    trials = real_trials(2, 60)
    predictor, h, model = Predictor(prepare(arm, trials)), Hypothesis(), arm
    values = {"c": 0.3, "b": 0.1, "width": 0.02, "k": 0.1, "J": 0.05}
    for pair in SPRINGS if family == "joint_spring" else PAIRS:
        effect = Library().effect(f"{family}:{pair}", arm, predictor.data.scales)
        own = {q.name: values[q.name] for q in effect.quantities}
        h = h.plus(effect, own)
        model = wrap(Library().effect(f"{family}:{pair}", model), own, STEP)
    x, u = trials[0].states[:-1], trials[0].inputs
    want = predictor.advance(h, x, u, np.zeros(len(x)))
    got = model.system.step(x, u, model.values, STEP)
    np.testing.assert_allclose(got, want, atol=1e-9)
    assert np.abs(want - predictor.step(x, u, arm.values)).max() > 1e-3
    assert not model.system.note  # it is compiled


def test_no_joint_is_made_of_what_drives_one_axis_or_is_tilted():
    def flown(s, a, p):
        lift = a.left + a.right
        return {
            "x": s.vx, "z": s.vz, "tilt": s.w,
            "vx": -lift * np.sin(s.tilt), "vz": lift * np.cos(s.tilt) - 9.81, "w": a.turn,
        }  # fmt: skip

    states = {"x": "m", "z": "m", "tilt": "rad", "vx": "m/s", "vz": "m/s", "w": "rad/s"}
    inputs = {"left": "1", "right": "1", "turn": "1"}
    assert pairs_of(Model(states=states, inputs=inputs, derivative=flown)) == []
    for model in (car, aircraft, replace(pendulum, inputs={"torque": "1"})):
        assert pairs_of(model) == []
