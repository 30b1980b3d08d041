"""Compiled open-loop predictions are those of single steps."""

from dataclasses import replace

import numpy as np
import pytest

from grounded import Trial
from grounded.diagnosis.likelihood import marching
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.joint_memory import remembering
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library
from grounded.effects.plain_step import plain_step
from grounded.models.pendulum import model as pendulum

DT, STEPS = 0.05, 60


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
