"""Effects that are the very same thing in a model: one name is offered, the one that says most.

A constant rate on a state may be just what a bias of an input does, or a parameter of the model; a
gain of a rate just what a time constant or a wheelbase does. Such a rate has no name of its own:

    offset:s, rate_gain:s   dropped where   d rate / d p  or  d rate / d u   is k times its own rate

at every one of many states and inputs, and at other parameters too.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from grounded.frozen import Array
from grounded.model import Model

SAMPLES = 40
SAME = 1e-7  # of the squared length: what may differ
SHORT = 1e-5  # [s], a step that shows the rates
BESIDE = 1.3  # times the parameters: where the slopes must agree too


def aliases(model: Model, idle: Iterable[str] = ()) -> dict[str, str]:
    """Names of rate effects that are the same as another effect: {dropped: kept}.

    Args:
        model: whose rates.
        idle: states that are carried along or set outright; they are not compared.
    """
    rng, n = np.random.default_rng(0), model.n
    x, u = rng.uniform(-1, 1, (SAMPLES, n)), rng.uniform(-1, 1, (SAMPLES, model.m))
    kept = [i for i, name in enumerate(model.state_names) if name not in set(idle)]
    found: dict[str, str] = {}
    here, there = (_Rates(model, x, u, p, kept) for p in (model.values, _beside(model)))
    for name, own in here.named.items():
        for other, slope in here.slopes.items():
            same = _along(slope, own) and _along(there.slopes[other], there.named[name])
            if same and name not in found and _free(model, other):
                found[name] = other
    return found


class _Rates:
    """Rates (SAMPLES, n) that named rate effects add, slopes of the model's rates by name."""

    def __init__(self, model: Model, x: Array, u: Array, p: Array, kept: list[int]) -> None:
        own = (model.system.step(x, u, p, SHORT) - x) / SHORT
        _, f_u, f_p = model.system.sensitivities(x, u, p, SHORT)
        self.named: dict[str, Array] = {}
        for i in kept:
            one = np.zeros_like(own)
            one[:, i] = 1.0
            name = model.state_names[i]
            self.named |= {
                f"offset:{name}": one[:, kept],
                f"rate_gain:{name}": (one * own)[:, kept],
            }
        inputs = {f"input_bias:{n}": f_u[:, kept, j] for j, n in enumerate(model.input_names)}
        params = {f"parameter:{n}": f_p[:, kept, k] for k, n in enumerate(model.param_names)}
        self.slopes = inputs | params


def _along(slope: Array, own: Array) -> bool:
    """Whether one is a multiple of the other, neither zero."""
    a, b = slope.reshape(-1), own.reshape(-1)
    lengths = float(a @ a) * float(b @ b)
    return bool(lengths > 0 and np.isfinite(lengths) and (a @ b) ** 2 > (1 - SAME) * lengths)


def _beside(model: Model) -> Array:
    """Other values of all parameters."""
    return np.where(model.values == 0, 0.1, BESIDE * model.values)


def _free(model: Model, name: str) -> bool:
    """Whether a parameter may halve and double, so that it can stand for the effect."""
    family, _, target = name.partition(":")
    if family != "parameter":
        return True
    param = model.params[target]
    low = -np.inf if param.low is None else param.low
    high = np.inf if param.high is None else param.high
    ends = (0.5 * param.value, 2 * param.value) if param.value else (-0.05, 0.05)
    return bool(low <= min(ends) and high >= max(ends))
