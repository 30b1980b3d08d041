"""Sensor effects in a model, and the true values behind delayed logs.

After a sensor's delay or lag was added to a model, its states are the logged (old or filtered)
values, and the true values are memory states:

    true+ = f(true, u)         effects on the motion (a friction, a current) act here
    y+    = old(true+, line)   line: true values of earlier steps, or the state of the filter

`seen_names` maps each name to the state with the value that the physics sees, `moved_model` returns
the model without its delayed sensors, and `logged` updates the logs after the true values moved.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.compile.names import Named
from grounded.effects.family import (
    Effect,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
    Values,
)
from grounded.effects.plain_step import Step, own_state, plain_step, quantities_of
from grounded.effects.sensor import lagging
from grounded.frozen import Array
from grounded.model import Model

Log = Callable[[Any, Mapping[str, Any], Any, Any], dict[str, Any]]  # (s, after, p, dt)


@dataclass(frozen=True, eq=False)
class Behind:
    """The true values behind a model's delayed logs.

    Args:
        model: the model without the delayed sensors.
        true: {state: memory state with its true value}.
        log: returns all states after a step from s, given `after` with correct true values.
    """

    model: Model
    true: Mapping[str, str]
    log: Log

    def lifted(self, model: Model) -> Behind:
        """Return the same for a model with a further effect on inputs, which may add memory."""

        def log(s: Any, after: Mapping[str, Any], p: Any, dt: Any) -> dict[str, Any]:
            own = {n: after[n] for n in model.state_names}
            return {**after, **self.log(own_state(model, s), own, p, dt)}

        return replace(self, log=log)


def behind_logs(model: Model) -> Behind | None:
    """Return the true values behind a model's delayed logs, or None."""
    found = getattr(model.step, "behind", None)
    return found if isinstance(found, Behind) else None


def seen_names(model: Model) -> tuple[str, ...]:
    """Return state names (n,) as effects see them: `v` is the true value, `v_logged` the log."""
    found = behind_logs(model)
    if found is None:
        return model.state_names
    own = {memory: name for name, memory in found.true.items()}
    logs = {name: f"{name}_logged" for name in found.true}
    return tuple((own | logs).get(name, name) for name in model.state_names)


def moved_model(model: Model) -> Model:
    """Return the model of the true values alone, with the current parameters."""
    found = behind_logs(model)
    if found is None:
        return model
    return replace(found.model, params={name: model.params[name] for name in found.model.params})


def logged(model: Model, x: Array, after: Array, p: Array, dt: float) -> Array:
    """Return states (..., n) after a step with the delayed logs and their memory updated.

    The result is linear in x (..., n) and `after`, which is correct in the true values, so that
    slopes can be passed instead of states. The parameters p are (k,), or (N, k) per row.
    """
    found = behind_logs(model)
    if found is None:
        return after
    names = model.state_names
    s, then = (Named("state", names, list(np.moveaxis(a, -1, 0))) for a in (x, after))
    values = Named("parameter", model.param_names, list(np.moveaxis(p, -1, 0)))
    made = found.log(s, then, values, dt)
    return np.stack([np.broadcast_to(made[n], x.shape[:-1]) for n in names], axis=-1)


def sensor_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    """Return a step whose states are the readings of a sensor with a bias or scale."""
    model, family = effect.site.model, effect.family
    assert isinstance(family, SensorFamily)
    base, seen = plain_step(model), effect.site.targets

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        c = quantities_of(effect, p)
        true = [family.recover(s[n], c) if n in seen else s[n] for n in model.state_names]
        after = base(Named("state", model.state_names, true), a, p, dt)
        return {n: family.measure(v, c) if n in seen else v for n, v in after.items()}

    return step, {}


def late_step(effect: Effect, whole: Values, dt: float) -> tuple[Step, dict[str, str]]:
    """Return a step whose states are the delayed logs, true values and their past as memory."""
    model, earlier = effect.site.model, behind_logs(effect.site.model)
    true = {n: _true_name(model, n) for n in effect.site.targets}
    make = _delayed if isinstance(effect.family, SensorDelayFamily) else _filtered
    show, memory = make(effect, true, whole, dt)
    base = plain_step(model)

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        return show(s, base(own_state(model, s, true), a, p, dt), p, dt)

    def log(s: Any, after: Mapping[str, Any], p: Any, dt: Any) -> dict[str, Any]:
        own = {n: after[true.get(n, n)] for n in model.state_names}
        if earlier:
            own = earlier.log(own_state(model, s, true), own, p, dt)
        return show(s, own, p, dt)

    first = Behind(model, {}, log) if earlier is None else earlier
    vars(step)["behind"] = Behind(first.model, {**true, **first.true}, log)
    return step, {z: model.states[n] for z, n in memory.items()}


def _delayed(
    effect: Effect, true: Mapping[str, str], whole: Values, dt: float
) -> tuple[Log, dict[str, str]]:
    assert isinstance(effect.family, SensorDelayFamily)
    depth = max(1, int(np.ceil(whole["d"] / dt - 1e-9)))
    lines = {n: [z, *[f"{z}_{i + 1}" for i in range(depth)]] for n, z in true.items()}

    def show(s: Any, after: Mapping[str, Any], p: Any, dt: Any) -> dict[str, Any]:
        old = quantities_of(effect, p)["d"] / dt
        found = dict(after)
        for n, past in lines.items():
            line = [after[n], *[s[z] for z in past]]
            part = [np.maximum(1 - np.abs(old - i), 0.0) for i in range(len(line))]
            found[n] = sum(part[i] * value for i, value in enumerate(line))
            found |= dict(zip(past, line, strict=False))
        return found

    return show, {z: n for n, past in lines.items() for z in past}


def _filtered(
    effect: Effect, true: Mapping[str, str], whole: Values, dt: float
) -> tuple[Log, dict[str, str]]:
    assert isinstance(effect.family, SensorLagFamily)

    def show(s: Any, after: Mapping[str, Any], p: Any, dt: Any) -> dict[str, Any]:
        tau, found = quantities_of(effect, p)["tau"], dict(after)
        for n, memory in true.items():
            off = lagging(s[n] - s[memory], after[n] - s[memory], tau, dt)
            found |= {n: after[n] + off, memory: after[n]}
        return found

    return show, {memory: n for n, memory in true.items()}


def _true_name(model: Model, target: str) -> str:
    """Return the name of the true value behind the log of `target`, which may be delayed twice."""
    name = f"{target}_true"
    return _true_name(model, name) if name in model.states else name
