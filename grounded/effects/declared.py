"""Effects in the numbers that a model declares: a wheel's radius, a steering offset, a rotor's k_T.

A gain g of an input, or of a rate, is a change of a constant p of the model where both have the
same slopes but for a factor c, at many random states and inputs:

    u df/du = c p df/dp     p -> p (1 + g)^c        such as v = r w: the radius r, c = 1
      df/du = c   df/dp     p -> p + c b            such as delta = u + p: the offset p, c = 1

and likewise with the model's own rate in place of u df/du. A parameter that is uncertain is a cause
of its own (`parameter`), so only constants are looked at.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from grounded import places
from grounded.effects.family import parallel
from grounded.effects.registry import SAMPLES
from grounded.frozen import Array
from grounded.model import Model

RELATIVE = {"input_gain": "g", "rate_gain": "g"}  # family: its quantity
ABSOLUTE = {"input_bias": "b", "offset": "c"}


@dataclass(frozen=True)
class Declared:
    """An effect as another value of a constant of the model.

    Args:
        parameter: its name.
        value: the value that has the same effect, in its unit.
        std: standard deviation of that.
        was: the value in the model.
    """

    parameter: str
    value: float
    std: float
    was: float


def declared(
    model: Model,
    effect: str,
    size: float,
    std: float,
    low: Array | None = None,
    high: Array | None = None,
) -> Iterator[Declared]:
    """Yield the constants of the model that an effect is another value of.

    Args:
        model: the model that was diagnosed.
        effect: name, `family:target`, of a family in RELATIVE or ABSOLUTE; none of others.
        size: the estimate of its g, b or c.
        std: standard deviation of it.
        low: lower limits of the inputs (m,); None: -1.
        high: upper limits (m,); None: 1.
    """
    family, _, target = effect.partition(":")
    constants = [name for name, one in model.params.items() if not one.uncertain]
    if family not in (*RELATIVE, *ABSOLUTE) or not constants or not 1 + size > 0:
        return
    slope, by_parameter = _slopes(model, family, target.split("+"), low, high)
    for name in constants:
        p = model.params[name].value
        own = by_parameter[:, :, model.param_names.index(name)]
        own = own * p if family in RELATIVE else own
        if not parallel(slope, own):
            continue
        c = float((slope * own).sum() / (own * own).sum())
        if family in RELATIVE:
            value = p * (1 + size) ** c
            yield Declared(name, value, abs(c * value / (1 + size)) * std, p)
        else:
            yield Declared(name, p + c * size, abs(c) * std, p)


def _slopes(
    model: Model, family: str, targets: Sequence[str], low: Array | None, high: Array | None
) -> tuple[Array, Array]:
    """Return what an effect adds to the rates, by its size (S, n), and their slopes (S, n, k)."""
    rng = np.random.default_rng(0)
    low = np.full(model.m, -1.0) if low is None else np.where(np.isfinite(low), low, -1.0)
    high = np.full(model.m, 1.0) if high is None else np.where(np.isfinite(high), high, 1.0)
    x, u = rng.uniform(-1, 1, (SAMPLES, model.n)), rng.uniform(low, high, (SAMPLES, model.m))
    dt = places.probe(model, places.INSTANT_S)
    _, f_u, f_p = model.system.sensitivities(x, u, model.values, dt)
    if family in ("input_gain", "input_bias"):
        at = [model.input_names.index(name) for name in targets]
        size = u[:, None, at] if family in RELATIVE else 1.0
        return (f_u[:, :, at] * size).sum(axis=2), f_p
    slope = np.zeros_like(x)
    own = model.system.step(x, u, model.values, dt) - x
    for i in map(model.state_names.index, targets):
        slope[:, i] = own[:, i] if family in RELATIVE else dt
    return slope, f_p
