"""Open-loop predictions of several hypotheses at once are those of each alone."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.likelihood import marching
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.joint_memory import remembering
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.validation.ruler import missed
from grounded.effects import Library
from grounded.effects.plain_step import plain_step
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


def turned(model):
    """The model as a step that returns its states in another order."""
    step = plain_step(model)

    def backwards(s, a, p, dt):
        return dict(reversed(step(s, a, p, dt).items()))

    return replace(model, derivative=None, step=backwards)


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
            met["rate"] += bool(each[0].rates)
            met["loss"] += bool(each[0].losses)
    assert different >= 0.7 * len(by_family)
    assert met["rate"] > 5
    assert met["loss"] or model is car


@pytest.mark.slow
@pytest.mark.parametrize("before", ["", "delay", "first_order_lag"])
@pytest.mark.parametrize("model", [pendulum, turned(pendulum)], ids=["derivative", "step"])
def test_a_compiled_hypothesis_goes_where_its_steps_lead(model, before, monkeypatch):
    monkeypatch.setattr(marching, "STEPS_TO_COMPILE", 1)
    data = data_of(model)
    predictor, compiled, refused = Predictor(data), set(), set()
    by_family = {e.family.name: e for e in Library().candidates(model, data.scales)}
    for effect in by_family.values():
        h = Hypothesis().plus(effect, valued(effect, 0.5))
        if not (h.rates or h.losses):
            continue
        if remembering(h):  # what a joint remembers follows from motion, whatever else acts on it
            h = h.plus(by_family["viscous_friction"], {"k": 0.4})
        if before:  # inputs that change within a step
            late = by_family[before]
            h = h.plus(late, {late.quantities[0].name: 0.4 * data.dt})
        sent = predictor.received(h, leads=True)
        x, u = predictor.widened(h, data.y[:-1])[0], sent[:, : len(data.y)].transpose(1, 0, 2)
        path = [x]
        with np.errstate(all="ignore"):
            for k, now in enumerate(u):
                path.append(predictor.advance(h, path[-1], now, np.full(len(x), k * data.dt)))
            found = marching.marched(predictor, h, x, u)
        (refused if found is None else compiled).add(effect.family.name)
        if found is not None:
            np.testing.assert_allclose(found, path, 1e-9, 1e-12, err_msg=effect.name)
    assert len(compiled) > 3 and {"periodic", "elastic_joint", "dahl_friction"} <= compiled
