"""Every effect: adopted and diagnosed one equation, it compiles, it is absent at its start."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from grounded import GroundedError, Model, Param
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import (
    InputFamily,
    Library,
    MemoryFamily,
    ParamFamily,
    Quantity,
    RateFamily,
    SensorLagFamily,
    memory_of,
    memory_start,
    scales_of,
    wrap,
)
from grounded.effects.actuator import first_order_lag, rate_limit
from grounded.effects.drive import weights_at
from grounded.effects.memory import Sent, shifted_within
from grounded.models.arm import model as arm
from grounded.models.car import model as car
from stepped import logged, slopes, stepped

DT = 0.05


def drive(steps=60):
    """A run of the car itself under lively inputs."""
    rng, t = np.random.default_rng(0), np.arange(steps) * DT
    u = np.stack([0.5 * np.sin(2 * t + 1), 0.45 + 0.3 * np.sin(1.3 * t)], axis=1)
    u += 0.05 * rng.standard_normal((steps, 2))
    return logged(car, stepped(car, u, DT, np.full(car.n, 0.1)), u, DT)


def typical(effect):
    """A middling value of every quantity."""
    return {
        q.name: float(np.sort(q.grid)[len(q.grid) // 2]) if q.grid else 0.02 for q in effect.free
    }


TRIAL = drive()
SIZES = scales_of(car, TRIAL.states, TRIAL.inputs, DT, TRIAL.steps * DT)
EFFECTS = Library().candidates(car, SIZES)
ONE_EACH = list({e.family.name: e for e in reversed(EFFECTS)}.values())


@pytest.mark.slow
@pytest.mark.parametrize("effect", ONE_EACH, ids=lambda e: e.name)
def test_an_adopted_effect_is_the_one_that_was_diagnosed(effect):
    values = typical(effect)
    wrapped = wrap(effect, values, DT)
    memory = memory_of(wrapped, car, TRIAL)
    z = np.hstack([TRIAL.states, memory])
    adopted = wrapped.system.step(z[:-1], TRIAL.inputs, wrapped.values, DT)[:, : car.n]

    predictor = Predictor(prepare(car, [TRIAL]))
    h = Hypothesis().plus(effect, values)
    x = TRIAL.states[:-1]
    if effect.family.name in ("sensor_bias", "sensor_scale"):
        i = car.state_names.index(effect.site.target)
        x = x.copy()
        x[:, i] = effect.family.recover(x[:, i], values)
    if effect.family.name in ("sensor_delay", "sensor_lag"):
        return  # the adopted one keeps a hidden true value; see their own tests
    means = predictor.inputs(h)[..., : car.m]  # plans take no more of what arrives in a step
    ahead = predictor.advance(h, x[:, None, :], means, predictor.data.time)[:, 0]
    if effect.family.name.startswith("sensor"):
        ahead = ahead + np.asarray(predictor.offset(h, ahead[:, None, :]))[..., 0, :]
    carried = car.state_names.index("psi_rate")  # by a short step in one of them
    np.testing.assert_allclose(adopted[:, carried], ahead[:, carried], atol=1e-3)
    np.testing.assert_allclose(
        np.delete(adopted, carried, 1), np.delete(ahead, carried, 1), atol=2e-6
    )


@pytest.mark.parametrize("effect", ONE_EACH, ids=lambda e: e.name)
def test_an_adopted_effect_compiles_and_its_derivatives_are_right(effect):
    wrapped = wrap(effect, typical(effect), DT)
    assert wrapped.system.how == "compiled", wrapped.system.note
    rng, p = np.random.default_rng(1), wrapped.values
    x, u = rng.uniform(0.2, 0.9, (4, wrapped.n)), rng.uniform(0.3, 0.8, (4, wrapped.m))
    f_x, f_u = wrapped.system.linearise(x, u, p, DT)
    found = slopes(lambda at: wrapped.system.step(at, u, p, DT), x)
    np.testing.assert_allclose(f_x, found, atol=2e-4, rtol=1e-4)
    assert np.isfinite(f_u).all()


@pytest.mark.parametrize("effect", ONE_EACH, ids=lambda e: e.name)
def test_an_effect_is_absent_at_its_start(effect):
    if not isinstance(effect.family, RateFamily | InputFamily | ParamFamily | MemoryFamily):
        return
    if any(q.grid for q in effect.free) and not isinstance(effect.family, MemoryFamily):
        values = {q.name: (q.start if q.start else 1e-12) for q in effect.free}
        if effect.family.name in ("patch", "periodic"):
            values = {**typical(effect), **dict.fromkeys(("c", "A", "B"), 0.0)}
            values = {q.name: values[q.name] for q in effect.free}
    else:
        values = {q.name: q.start or 1e-9 for q in effect.free}
    if effect.family.name == "rate_limit":
        values = {"r": 1e8}  # the first command is a jump from what was held before
    predictor = Predictor(prepare(car, [TRIAL]))
    x = TRIAL.states[:-1][:, None, :]
    with_it = predictor.next(Hypothesis().plus(effect, values), x)
    without = predictor.next(Hypothesis(), x)
    carried = car.state_names.index("psi_rate")
    np.testing.assert_allclose(with_it[..., carried], without[..., carried], atol=1e-3)
    np.testing.assert_allclose(
        np.delete(with_it, carried, -1), np.delete(without, carried, -1), atol=1e-5
    )


def test_an_unknown_effect_names_the_nearest():
    with pytest.raises(GroundedError, match="dead_zone"):
        Library().effect("deadzone:throttle", car)
    with pytest.raises(GroundedError, match="throttle"):
        Library().effect("dead_zone:throtle", car)


def test_a_third_party_family_is_one_value():
    drag = RateFamily(
        name="cubic_drag",
        equation="v' = model - k v^3",
        sentence="{target} has a cubic drag of {k}",
        targets=lambda model: [n for n, u in model.states.items() if u == "m/s"],
        quantities=lambda site: (Quantity("k", "s/m^2"),),
        rate=lambda s, a, own, t, c, site: {site.target: -c["k"] * s[site.target] ** 3},
    )
    library = Library().with_families([drag])
    effect = library.effect("cubic_drag:v", car, SIZES)
    assert wrap(effect, {"k": 0.1}, DT).system.how == "compiled"
    with pytest.raises(GroundedError, match="cubic_drag"):
        library.with_families([drag])


def test_a_black_box_model_takes_effects_too():
    def step(s, a, p, dt):
        if s["v"] > 1e9:  # a Python `if` on a state: can't be traced
            return {"v": 0.0}
        return {"v": s["v"] + dt * (a["u"] - p["k"] * s["v"])}

    box = Model(
        states={"v": "m/s"}, inputs={"u": "m/s^2"}, params={"k": Param(0.5, "1/s")}, step=step
    )
    effect = Library().effect("coulomb_friction:v", box)
    wrapped = wrap(effect, {"c": 0.2}, DT)
    after = wrapped.system.step(np.array([[1.0]]), np.array([[0.0]]), wrapped.values, DT)
    assert after[0, 0] == pytest.approx(1.0 - DT * 0.7, abs=2e-3)


def test_several_effects_wrap_one_another():
    model = car
    for name, values in (
        ("viscous_friction:v", {"k": 0.1}),
        ("dead_zone:throttle", {"c": 0.05}),
        ("first_order_lag:steering", {"tau": 0.1}),
        ("delay:throttle", {"d": 0.07}),
    ):
        model = wrap(Library().effect(name, model, SIZES), values, DT)
    assert model.system.how == "compiled"
    assert model.n == car.n + 1 + 3
    assert memory_of(model, car, TRIAL).shape == (TRIAL.steps + 1, 4)


def test_an_adopted_sensor_lag_is_a_filter():
    effect = Library().effect("sensor_lag:v", car, SIZES)
    assert isinstance(effect.family, SensorLagFamily)
    model = wrap(effect, {"tau": 0.2}, DT)
    one = TRIAL.until(40)
    start = np.hstack([one.states[0], memory_start(model, car, one)])
    z, names = stepped(model, one.inputs, DT, start), model.state_names
    true, shown = (z[:, names.index(name)] for name in ("v_true", "v"))
    filtered, fine = [true[0]], true[0]
    for before, after in itertools.pairwise(true):
        for k in range(200):
            now = before + (after - before) * (k + 0.5) / 200
            fine += (now - fine) * DT / 200 / 0.2
        filtered.append(fine)
    np.testing.assert_allclose(shown, filtered, atol=2e-3 * np.ptp(true))
    assert np.abs(shown - true).max() > 0.02


def test_a_logged_heading_that_is_two_steps_old_is_the_true_one_of_then():
    wrapped = wrap(Library().effect("sensor_delay:psi", car, SIZES), {"d": 2 * DT}, DT)
    z = np.concatenate([TRIAL.states[20], memory_of(wrapped, car, TRIAL)[20]])
    after = wrapped.system.step(z[None], TRIAL.inputs[20][None], wrapped.values, DT)[0]
    names = wrapped.state_names
    # the log of step 21 is the truth of step 19, which step 20 calls "one ago"
    assert after[names.index("psi")] == pytest.approx(z[names.index("psi_true_1")], abs=1e-12)


def test_the_docs_have_a_row_for_every_family():
    text = (Path(__file__).parents[2] / "docs" / "effects.md").read_text(encoding="utf-8")
    assert all(f"| `{family.name}` |" in text for family in Library().families)


@pytest.mark.parametrize("tau", [0.02, 0.07])
def test_a_long_way_goes_at_the_limit_and_arrives(tau, dt=0.02):
    """However stiff the model that drives it."""
    servo = Model(
        states={"angle": "rad"},
        inputs={"command": "rad"},
        params={"tau": Param(tau, "s", std=0.3 * tau)},
        derivative=lambda s, a, p: {"angle": (a.command - s.angle) / p.tau},
    )
    fast = wrap(Library().effect("slew_limit:angle", servo), {"r": 1.5}, dt)
    x = stepped(fast, np.full(60, 0.6), dt)[:, 0]
    np.testing.assert_allclose(x[1:16], 1.5 * dt * np.arange(1, 16), atol=1e-12)
    assert x[-1] == pytest.approx(0.6, abs=1e-3)
    assert np.diff(x).max() <= 1.5 * dt + 1e-12


STEP, FINE = 0.02, 200


def received(name, value, commands):
    """The torque at the middle of every fine part of every step, (T, FINE)."""
    t = (np.arange(FINE) + 0.5) / FINE * STEP
    found, z = [], commands[0]
    late = np.concatenate([np.repeat(commands[:1], 50), commands])
    for k, u in enumerate(commands):
        if name == "delay":
            back = np.floor((k * STEP + t - value) / STEP + 1e-9).astype(int)
            found.append(late[back + 50])
        elif name == "first_order_lag":
            found.append(u + (z - u) * np.exp(-t / value))
            z = u + (z - u) * np.exp(-STEP / value)
        else:
            found.append(z + np.clip(u - z, -value * t, value * t))
            z += float(np.clip(u - z, -value * STEP, value * STEP))
    return np.array(found)


CASES = [("delay", 0.0083), ("delay", 0.0312), ("first_order_lag", 0.012), ("rate_limit", 15.0)]


@pytest.mark.parametrize(("name", "value"), CASES)
def test_a_lead_is_the_first_moment_of_what_arrives_in_a_step(name, value):
    rng = np.random.default_rng(1)
    u = np.repeat(rng.uniform(-1, 1, 50), 3) + 0.2 * rng.standard_normal(150)
    arriving = received(name, value, u)
    early = 0.5 - (np.arange(FINE) + 0.5) / FINE
    expected = (early * arriving).mean(axis=1)
    if name == "delay":
        still = np.zeros((1, len(u)))
        (mean,), (found,) = shifted_within(
            Sent(u[None], u[:1], still, u[None], still), value / STEP
        )
        np.testing.assert_allclose(mean, arriving.mean(axis=1), atol=2e-3)
    else:
        family = {"first_order_lag": first_order_lag, "rate_limit": rate_limit}[name]
        c = {"tau": value} if name == "first_order_lag" else {"r": value}
        found = family.lead(u, family.along(u[None], u[:1], c, STEP)[0], c, STEP)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert np.abs(expected).max() > 0.02


def test_the_weights_of_a_wheels_speed_follow_the_track():
    cart = Model(
        name="cart",  # as a textbook has it, with a crude track
        states={"psi": "rad", "v": "m/s", "r": "rad/s"},
        inputs={"left": "1", "right": "1"},
        params={
            "k": Param(0.8, "m/s", 0.3, 2.0),
            "track": Param(0.25, "m", 0.15, 0.5),
            "tau": Param(0.2, "s", 0.03, 1.0),
            "tau_r": Param(0.2, "s", 0.03, 1.0),
        },
        angles=("psi",),
        derivative=lambda s, a, p: {
            "psi": s.r,
            "v": (p.k * (a.left + a.right) / 2 - s.v) / p.tau,
            "r": (p.k * (a.right - a.left) / p.track - s.r) / p.tau_r,
        },
    )
    crudely = dict(zip(cart.param_names, cart.values, strict=True))
    values = crudely | {"track": 0.3, "tau_r": 0.1, "delay_d": 0.02}  # of an adopted effect, too
    for name, side in (("left", -1), ("right", 1)):
        at = weights_at(cart, f"{name}<-v+r", values)
        crude = weights_at(cart, f"{name}<-v+r", crudely)
        other = {one for one in at if one != next(iter(at))}.pop()
        ratio = {"r": 0.15, "v": 1 / 0.15}[other]
        assert at[other] == pytest.approx(side * ratio, rel=1e-6)
        assert crude[other] == pytest.approx(side * (0.125 if other == "r" else 8.0), rel=1e-6)
    assert weights_at(arm, "tau1<-w1", {}) == {"w1": 1.0}
