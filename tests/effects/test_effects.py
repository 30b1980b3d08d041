"""Every effect: adopted and diagnosed one equation, it compiles, it is absent at its start."""

import itertools

import numpy as np
import pytest

from grounded import GroundedError, Model, Param, Trial
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
from grounded.models.car import model as car

DT = 0.05


def drive(model=car, seed=0, steps=60):
    """A run of the model itself under lively inputs."""
    rng = np.random.default_rng(seed)
    t = np.arange(steps) * DT
    u = np.stack([0.5 * np.sin(2 * t + 1), 0.45 + 0.3 * np.sin(1.3 * t)], axis=1)
    u = u[:, : model.m] + 0.05 * rng.standard_normal((steps, model.m))
    x = [np.full(model.n, 0.1)]
    for row in u:
        x.append(model.system.step(x[-1][None], row[None], model.values, DT)[0])
    held = np.zeros(model.m)
    return Trial(np.array(x), u, DT, model.state_names, model.input_names, start_inputs=held)


def sizes(trial, model=car):
    return scales_of(model, trial.states, trial.inputs, DT, trial.steps * DT)


def typical(effect):
    """A middling value of every quantity."""
    values = {}
    for q in effect.free:
        if q.grid:
            values[q.name] = float(np.sort(q.grid)[len(q.grid) // 2])
        else:
            values[q.name] = 0.02
    return values


TRIAL = drive()
EFFECTS = Library().candidates(car, sizes(TRIAL))
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
    rng = np.random.default_rng(1)
    x = rng.uniform(0.2, 0.9, (4, wrapped.n))
    u = rng.uniform(0.3, 0.8, (4, wrapped.m))
    f_x, f_u = wrapped.system.linearise(x, u, wrapped.values, DT)
    h = 1e-6
    for j in range(wrapped.n):
        nudge = np.zeros(wrapped.n)
        nudge[j] = h
        ends = [wrapped.system.step(x + s * nudge, u, wrapped.values, DT) for s in (1, -1)]
        np.testing.assert_allclose(
            f_x[:, :, j], (ends[0] - ends[1]) / (2 * h), atol=2e-4, rtol=1e-4
        )
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
    effect = library.effect("cubic_drag:v", car, sizes(TRIAL))
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
        model = wrap(Library().effect(name, model, sizes(TRIAL)), values, DT)
    assert model.system.how == "compiled"
    assert model.n == car.n + 1 + 3
    assert memory_of(model, car, TRIAL).shape == (TRIAL.steps + 1, 4)


def test_sensor_delay():
    """A logged heading that is 0.1 s old is the true heading two steps ago."""
    effect = Library().effect("sensor_delay:psi", car, sizes(TRIAL))
    wrapped = wrap(effect, {"d": 2 * DT}, DT)
    memory = memory_of(wrapped, car, TRIAL)
    z = np.concatenate([TRIAL.states[20], memory[20]])
    after = wrapped.system.step(z[None], TRIAL.inputs[20][None], wrapped.values, DT)[0]
    names = wrapped.state_names
    # d = 2 steps: the log of step 21 is the truth of step 19, which step 20 calls "one ago"
    assert after[names.index("psi")] == pytest.approx(z[names.index("psi_true_1")], abs=1e-12)


def test_the_docs_have_a_row_for_every_family():
    from pathlib import Path

    text = (Path(__file__).parents[2] / "docs" / "effects.md").read_text(encoding="utf-8")
    for family in Library().families:
        assert f"| `{family.name}` |" in text


def test_an_adopted_sensor_lag_is_a_filter():
    effect = Library().effect("sensor_lag:v", car, sizes(TRIAL))
    assert isinstance(effect.family, SensorLagFamily)
    model = wrap(effect, {"tau": 0.2}, DT)
    one = TRIAL.until(40)
    z = [np.hstack([one.states[0], memory_start(model, car, one)])]
    for u in one.inputs:
        z.append(model.system.step(z[-1][None], u[None], model.values, DT)[0])
    names = model.state_names
    true, logged = (np.array(z)[:, names.index(name)] for name in ("v_true", "v"))
    filtered, fine = [true[0]], true[0]
    for before, after in itertools.pairwise(true):
        for k in range(200):
            now = before + (after - before) * (k + 0.5) / 200
            fine += (now - fine) * DT / 200 / 0.2
        filtered.append(fine)
    np.testing.assert_allclose(logged, filtered, atol=2e-3 * np.ptp(true))
    assert np.abs(logged - true).max() > 0.02
