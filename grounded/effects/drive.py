"""The speed of a drive: one velocity of the model, or a wheel's, which several of them turn.

A joint's motor turns as fast as the joint. The wheels of a robot that drives by two of them don't
move with any velocity of its model, but with a combination,

    left wheel   v - h psi' (- r q', if its body pitches)
    right wheel  v + h psi'

and so do the losses in its motors and gears. The combination is read from the model. If the model
has what a motor's own speed costs it (back-EMF, viscous friction), then

    d(accelerations) / d(velocities) = -F W,      F = d(accelerations) / d(inputs)

and row j of W is the combination of input j. W is found by least squares over several states; the
mean over opposite velocities removes centrifugal terms. It counts if F W explains the whole, so
that no friction of another origin is taken for a motor's.

The weights depend on the model's parameters: h is half its track. While these are fitted, the
weights follow (`weights_at`): else frictions would stand for a track that is larger than modelled.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from grounded import places
from grounded.effects.family import Effect
from grounded.frozen import Array
from grounded.model import Model

WHOLE = 0.02  # largest part of the accelerations' slopes that F W may leave unexplained
SMALLEST_WEIGHT = 1e-3  # smallest weight of a velocity, relative to the largest
MOST_VELOCITIES = 3  # velocities in a combination


@lru_cache(maxsize=places.MODELS_KEPT)
def combined_speeds(model: Model) -> Mapping[str, Mapping[str, float]]:
    """Return the speeds of drives that are combinations: {input: {velocity: weight}}.

    The velocity with the largest weight is first, and has the weight 1. Drives of a single velocity
    are left out, and simulators with a step of their own.
    """
    model = places.motion(model)
    names = _velocities(model)
    if getattr(model.step, "timestep", 0.0) or len(names) < 2:
        return {}
    F, slopes = _slopes(model, model.values)
    if np.linalg.matrix_rank(F.reshape(-1, model.m)) < model.m:
        return {}
    W = _combinations(F, slopes)
    left = np.linalg.norm(slopes + F @ W, axis=(0, 2))
    if (left > WHOLE * np.linalg.norm(slopes, axis=(0, 2)) + 1e-9).any():
        return {}
    found = {}
    for j, tau in enumerate(model.input_names):
        main = int(np.argmax(np.abs(W[j])))
        weights = {n: w / W[j, main] for n, w in zip(names, W[j], strict=True) if W[j, main]}
        own = {n: float(w) for n, w in weights.items() if abs(w) > SMALLEST_WEIGHT}
        if 1 < len(own) <= MOST_VELOCITIES and F[:, main, j].min() > 0 and W[j, main] > 0:
            found[tau] = {names[main]: 1.0} | own
    return found


def _velocities(model: Model) -> list[str]:
    return [name for name in places.velocities(model) if name in model.state_names]


def _combinations(F: Array, slopes: Array) -> Array:
    """Return W (m, v) by least squares."""
    flat = F.reshape(-1, F.shape[-1])
    return -np.asarray(np.linalg.lstsq(flat, slopes.reshape(len(flat), -1), rcond=None)[0])


def _slopes(model: Model, values: Array) -> tuple[Array, Array]:
    """Return slopes of the accelerations by inputs (S, v, m) and by velocities (S, v, v)."""
    dt, (x, u) = places.probe(model, places.INSTANT_S), places.samples(model, 8)
    at = [model.state_names.index(name) for name in _velocities(model)]
    back = x.copy()
    back[:, at] *= -1
    ways = [model.system.linearise(states, u, values, dt) for states in (x, back)]
    f_x, f_u = (np.mean([way[k] for way in ways], axis=0) for k in (0, 1))
    slopes = (f_x[:, at][:, :, at] - np.eye(len(at))) / dt
    return f_u[:, at] / dt, slopes


def speed_weights(model: Model, target: str) -> Mapping[str, float]:
    """Return the velocities in the speed that a loss at `tau<-w` or `tau<-w+w2` depends on."""
    tau, _, w = target.partition("<-")
    return combined_speeds(model)[tau] if "+" in w else {w: 1.0}


def weights_at(model: Model, target: str, given: Mapping[str, float]) -> Mapping[str, float]:
    """Return `speed_weights` of a model with other parameters, by name, also of effects.

    They are those of the model itself where its slopes tell none at these parameters.
    """
    found = speed_weights(model, target)
    if len(found) < 2:
        return found
    inner = places.motion(model)
    values = np.array([given[name] for name in inner.param_names], float)
    row = inner.input_names.index(target.partition("<-")[0])
    with np.errstate(all="ignore"):
        F, slopes = _slopes(inner, values)
        if not (np.isfinite(F).all() and np.isfinite(slopes).all()):
            return found
        W, names = _combinations(F, slopes)[row], _velocities(inner)
        weights = {name: W[names.index(name)] / W[names.index(next(iter(found)))] for name in found}
    return weights if np.isfinite(list(weights.values())).all() else found


def speed(effect: Effect, values: Any, weights: Mapping[str, Any] | None = None) -> Any:
    """Return the speed that a loss depends on, given values by state, or their changes.

    `weights` of the velocities; None: those of the effect's model (`speed_weights`).
    """
    total: Any = 0.0
    if weights is None:
        weights = speed_weights(effect.site.model, effect.site.joined)
    for k, (name, weight) in enumerate(weights.items()):  # the weight of the first one is 1
        total = total + (weight * values[name] if k else values[name])
    return total


@lru_cache(maxsize=places.MODELS_KEPT)
def push(model: Model, target: str) -> float:
    """Return the median acceleration of a drive, `tau<-w`, per unit of the input."""
    tau = target.partition("<-")[0]
    _, f_u, dt = places.slopes(model, places.INSTANT_S)
    by, weights = f_u[..., model.input_names.index(tau)], speed_weights(model, target)
    total = sum(k * by[:, model.state_names.index(name)] for name, k in weights.items())
    return float(np.median(total)) / dt


def motion_of(effect: Effect) -> str:
    """Return the motion that an effect opposes: a state, or the whole target of a combination."""
    if len(effect.site.targets) > 1 and "<-" in effect.site.target:
        return effect.site.joined
    return effect.site.target.rpartition("<-")[2]
