"""Memories of joints (bristles, springs) along a track, and after a step from anywhere.

They follow from the motion and the received inputs alone (`effects.elastic`), so they have no noise
of their own and no row in the filter:

    z_{t+1} = later(w_t, w_{t+1}, B, u_t, z_t)         B: a median, since it only tells how w went

Along a track w are its own speeds, from the start of each trial on, where z is at rest. Where a
prediction leaves the track, z goes on with the predicted speeds, as columns behind its states.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.compile import system_of
from grounded.compile.run.interpreted import System
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Effect, LossFamily
from grounded.effects.drive import push, speed
from grounded.effects.family import coupled
from grounded.frozen import Array

if TYPE_CHECKING:
    from grounded.diagnosis.likelihood.predictor import Predictor

Remembering = list[tuple[Effect, Mapping[str, float], tuple[str, ...]]]


def remembering(h: Hypothesis) -> Remembering:
    """Return the losses with a memory, with their values and the names of it."""
    each = [(e, v, tuple(e.family.memory(e.site))) for e, v in h.losses]
    return [(e, v, names) for e, v, names in each if names]


def at(h: Hypothesis, z: Array) -> Hypothesis:
    """Return a hypothesis with its memories z (..., k) among its values."""
    here, k = dict[str, Mapping[str, Any]](), 0
    for effect, _, names in remembering(h):
        here[effect.name] = {name: z[..., k + i] for i, name in enumerate(names)}
        k += len(names)
    return replace(h, values=tuple({**v, **here.get(e.name, {})} for e, v in h.pairs))


def after(predictor: Predictor, h: Hypothesis, x: Array, reached: Array, u: Array) -> Array:
    """Return the memories (..., k) after a step from x to `reached` (..., n) under inputs u."""
    inputs, found = predictor.data.model.input_names, list[Array]()
    weights = dict(zip((e.name for e, _ in h.losses), _weights(predictor, h, x), strict=True))
    for effect, c, names in remembering(h):
        ends = [speed(effect, predictor.named(end), weights[effect.name]) for end in (x, reached)]
        sent = u[..., inputs.index(coupled(effect.site)[0])]
        gain = push(effect.site.model, effect.site.joined) * predictor.data.dt
        kept = effect.family.later(*ends, gain, sent, c, predictor.data.dt)  # type: ignore[attr-defined]
        found += [np.broadcast_to(kept[name], sent.shape) for name in names]
    return np.stack(found, axis=-1)


def along(predictor: Predictor, h: Hypothesis, x: Array) -> Array:
    """Return the memories (L, B, k) at the start of each step of a track x (L, B, n)."""
    data, own = predictor.data, remembering(h)
    states, steps = data.filled.copy(), data.valid.T > 0
    states[data.state_at.T[:-1][steps]] = x[steps]
    begin = np.cumsum([0, *(data.lengths[:-1] + 1)])[:, None]
    T = data.commands.shape[1]
    whole = states[begin + np.minimum(np.arange(T + 1), data.lengths[:, None])]  # (S, T + 1, n)
    sent, found = predictor.received(h), list[Array]()
    weights = dict(zip((e.name for e, _ in h.losses), _weights(predictor, h, x), strict=True))
    for effect, c, names in own:
        w = speed(effect, predictor.named(whole), weights[effect.name])
        j = data.model.input_names.index(coupled(effect.site)[0])
        system = _system(effect.family, names, tuple(sorted(c)))
        start = effect.family.rest(data.held[:, j], c)  # type: ignore[attr-defined]
        z = np.stack([start[name] for name in names], axis=-1)
        gain = np.full(w[:, 1:].T.shape, push(effect.site.model, effect.site.joined) * data.dt)
        given = np.stack([w[:, :-1].T, w[:, 1:].T, gain, sent[..., j].T], axis=-1)
        p = np.array([c[name] for name in sorted(c)])
        path = _marched(system, z, given, p, data.dt)
        found.append(data.runs(path[:-1].swapaxes(0, 1)))
    return np.concatenate(found, axis=-1)


def _weights(predictor: Predictor, h: Hypothesis, x: Array) -> list[Mapping[str, Any]]:
    return predictor.weights(h, predictor.params(h), x.shape[:-1])


def _marched(system: System, z: Array, given: Array, p: Array, dt: float) -> Array:
    if march := getattr(system, "march", None):
        return np.asarray(march(z, np.ascontiguousarray(given), p, dt))
    path = [z]
    for now in given:
        path.append(system.step(path[-1], now, p, dt))
    return np.stack(path)


@cache
def _system(family: LossFamily, names: tuple[str, ...], quantities: tuple[str, ...]) -> System:
    """Compile how a memory goes on, as the step of a system with the speeds among its inputs."""

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        c = {name: p[name] for name in quantities} | {name: s[name] for name in names}
        return dict(family.later(a.w, a.end, a.gain, a.u, c, dt))

    return system_of(
        step,
        kind="step",
        states=names,
        inputs=("w", "end", "gain", "u"),
        params=quantities,
        derivatives=False,
    )
