"""Exact memories: states without a sensor whose next values depend on the inputs alone.

A model may remember where a command was, or how far an unmeasured servo has followed it. Nothing
disturbs such a state, and its path follows from the commands that are received:

    z_{t+1} = f_z(z_t, u_t)

With process noise of its own, it would follow the log instead of the commands, and swallow
whatever they lack. Its start is not known: it is taken as settled at the first command. A velocity
is none: what the model lacks pushes it, and the log of its place shows it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from grounded import places
from grounded.frozen import Array
from grounded.model import Model


def memories(model: Model, unmeasured: Sequence[int] | Any, dt: float) -> tuple[int, ...]:
    """Return the indices of exact memories among states that no trial shows.

    These depend on inputs and on each other alone, are not constant and no velocities.
    """
    if not len(unmeasured):
        return ()
    moving = {*places.velocities(model), *(rate for rate, _ in places.integrated(model).values())}
    found = {int(i) for i in unmeasured if model.state_names[i] not in moving}
    reads = model.system.reads(model.values, dt)
    while True:
        of = {i: {*np.flatnonzero(reads[i]).tolist()} for i in found}
        kept = {i for i, own in of.items() if own & {*range(model.n)} <= found and own - {i}}
        if kept == found:
            return tuple(sorted(found))
        found = kept


def recalled(model: Model, own: Sequence[int], received: Array, p: Array, dt: float) -> Array:
    """Return the paths of memories (S, T + 1, k) under received inputs (S, T, m).

    Args:
        model: the model.
        own: indices of its k exact memories.
        received: the inputs.
        p: the model's parameters (k,).
        dt: time step [s].
    """
    # settled: z = f(z, u), one Newton step from 0; the shortest where none or many are
    at, system = list(own), model.system
    x, u = np.zeros((len(received), model.n)), np.ascontiguousarray(received.swapaxes(0, 1))
    A = system.linearise(x, u[0], p, dt)[0][:, at][:, :, at]
    moved = system.step(x, u[0], p, dt)[:, at]
    x[:, at] = (np.linalg.pinv(np.eye(len(at)) - A) @ moved[..., None])[..., 0]
    if march := getattr(system, "march", None):
        return np.asarray(march(x, u, p, dt)[..., at].swapaxes(0, 1))
    path = [x]
    for now in u:
        path.append(system.step(path[-1], now, p, dt))
    return np.stack(path, axis=1)[..., at]
