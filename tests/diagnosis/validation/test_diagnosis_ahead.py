"""Open-loop predictions of several hypotheses at once are those of each alone."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.likelihood import marching
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, losses_of, rates_of
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ahead import missed, unseen
from grounded.diagnosis.validation.ruler import Ruler
from grounded.effects import Library, wrap
from grounded.models.car import model as car
from grounded.models.pendulum import model as pendulum

DT, STEPS, AHEAD = 0.05, 60, 8
PARTS = (0.2, 0.5, 0.9)  # of a value's grid, or of its bounds
MOMENTS = np.array([1, 5, 9, 20, 33, 50])


def data_of(model):
    rng, names = np.random.default_rng(1), (tuple(model.states), tuple(model.inputs))
    trials = []
    for _ in range(3):
        u = 0.3 * rng.standard_normal((STEPS, model.m))
        x = [0.3 * np.ones(model.n)]
        for now in u:
            x.append(model.system.step(x[-1][None], now[None], model.values, DT)[0])
        y = np.array(x) + 1e-3 * rng.standard_normal((STEPS + 1, model.n))
        trials.append(Trial(y, u, DT, *names))
    return prepare(model, trials)


def valued(effect, part):
    """Some value of each free quantity."""
    found = {}
    for q in effect.free:
        low, high = max(q.low, -0.2), min(q.high, 0.4)
        found[q.name] = float(np.quantile(q.grid, part)) if q.grid else low + part * (high - low)
    return found


@pytest.mark.parametrize(("model", "freed"), [(pendulum, True), (car, False)])
def test_all_folds_together_are_each_alone(model, freed):
    data = data_of(model)
    predictor, rng = Predictor(data), np.random.default_rng(2)
    by_family = {e.family.name: e for e in Library().candidates(model, data.scales)}
    which, run = np.tile([0, 2, 1], 2), np.array([0, 1, 2, 2, 1, 0])
    track, different, met = data.y, 0, {"rate": 0, "loss": 0}
    with np.errstate(all="ignore"):
        for effect in by_family.values():
            each = [Hypothesis().plus(effect, valued(effect, part)) for part in PARTS]
            if freed:
                shifts = 0.02 * model.values * rng.standard_normal((3, len(model.values)))
                each = [replace(h, shift=s, spread=0.1) for h, s in zip(each, shifts, strict=True)]
            together = missed(predictor, each, which, track, MOMENTS, run, AHEAD)
            for i, h in enumerate(each):
                own = which == i
                alone = missed(predictor, [h], 0 * run[own], track, MOMENTS[own], run[own], AHEAD)
                assert np.isfinite(alone).any()
                np.testing.assert_allclose(
                    together[:, own], alone, rtol=1e-9, atol=1e-12, err_msg=effect.name
                )
            other = missed(predictor, each[:1], 0 * which, track, MOMENTS, run, AHEAD)
            different += not np.array_equal(other, together, equal_nan=True)
            met["rate"] += bool(rates_of(each[0]))
            met["loss"] += bool(losses_of(each[0]))
    assert different >= 0.7 * len(by_family)
    assert met["rate"] > 5
    assert met["loss"] or model is car


@pytest.mark.slow
@pytest.mark.parametrize("model", [pendulum], ids=["pendulum"])
def test_a_compiled_hypothesis_goes_where_its_steps_lead(model, monkeypatch):
    monkeypatch.setattr(marching, "LONG", 1)
    data = data_of(model)
    predictor, compiled, refused = Predictor(data), set(), set()
    by_family = {e.family.name: e for e in Library().candidates(model, data.scales)}
    for effect in by_family.values():
        h = Hypothesis().plus(effect, valued(effect, 0.5))
        if not (rates_of(h) or losses_of(h)):
            continue
        x, u = data.y[0], predictor.received(h)[:, : len(data.y)].transpose(1, 0, 2)
        path = [x]
        with np.errstate(all="ignore"):
            for k, now in enumerate(u):
                path.append(predictor.advance(h, path[-1], now, np.full(len(x), k * data.dt)))
            found = marching.marched(predictor, h, x, u)
        (refused if found is None else compiled).add(effect.family.name)
        if found is not None:
            room = {"rtol": 1e-3, "atol": 0.01} if model is car else {"rtol": 1e-9, "atol": 1e-12}
            np.testing.assert_allclose(found, path, **room, err_msg=effect.name)
    assert len(compiled) > 3 and "periodic" in compiled


def test_a_compiled_hypothesis_joins_what_was_adopted_before(monkeypatch):
    monkeypatch.setattr(marching, "LONG", 1)
    late = wrap(Library().effect("first_order_lag:torque", pendulum), {"tau": 0.08}, DT)
    data = data_of(late)
    predictor = Predictor(data)
    effect = next(e for e in Library().candidates(late, data.scales) if e.family.name == "stiction")
    h = Hypothesis().plus(effect, valued(effect, 0.5))
    x, u = data.y[0], predictor.received(h)[:, : len(data.y)].transpose(1, 0, 2)
    found = marching.marched(predictor, h, x, u)
    assert found is not None
    np.testing.assert_allclose(found[1], predictor.advance(h, x, u[0], np.zeros(len(x))))


def test_a_late_log_is_predicted_only_from_where_the_start_has_not_used_it():
    """A hypothesis whose filter follows a late log told that log 0.1 s ahead "to 0.2 mm/s"."""
    rng, noise = np.random.default_rng(3), 0.01
    y = noise * rng.standard_normal((STEPS + 1, car.n))
    trial = Trial(y, np.zeros((STEPS, car.m)), DT, tuple(car.states), tuple(car.inputs))
    data = prepare(car, [trial])
    predictor, i = Predictor(data), car.state_names.index("v")
    late = Library().effect("sensor_delay:v", car, data.scales)
    h = Hypothesis().plus(late, {"d": 2 * DT})
    first = unseen(predictor, h)
    assert first[i] == 3 and np.delete(first, i).max() == 1
    assert unseen(predictor, Hypothesis()).max() == 1
    track = data.y.copy()
    track[:-2, :, i] = data.y[2:, :, i]  # a filter that follows the log, two steps late
    ruler = Ruler(predictor)
    found, seen = ruler._none(), ruler._none()
    for errors, at in ((found, first), (seen, np.ones_like(first))):
        ruler._add(errors, [h], np.zeros(len(data.valid), int), track, at)
    assert seen.rms[0, i] < 1e-6 < 0.7 * noise < found.rms[0, i]
    others = np.delete(found.rms[0], i)
    np.testing.assert_array_equal(others, np.delete(seen.rms[0], i))
    assert found.rms[-2, i] == seen.rms[-2, i]  # a second ahead, nothing was used


def test_predictions_start_where_what_is_behind_a_late_log_is_known():
    """An adopted late sensor made a boat's speed, known to 6 mm/s, miss by 12 a second ahead."""
    from grounded.places import true_values

    data = data_of(car)
    late = wrap(Library().effect("sensor_delay:v", car), {"d": 2.5 * DT}, DT)
    hidden = late.state_names[car.n :]
    assert true_values(late.state_names, hidden)
    run = data.states[: STEPS + 1]
    start = {name: run[0, car.state_names.index("v")] for name in hidden}
    states = np.column_stack([run, *(np.full(len(run), value) for value in start.values())])
    names = late.state_names, late.input_names
    trial = Trial(states, np.zeros((STEPS, car.m)), DT, *names)
    behind = prepare(late, [trial], hidden=hidden)
    assert data.begin.max() == 1 and behind.begin.min() > 1
    ruler = Ruler(Predictor(behind))
    assert (ruler.starts[0] >= behind.begin[ruler.starts[1]]).all()
