"""Unknowns of a fit: parameters of the model and delays of its inputs, as one vector theta."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from grounded.errors import GroundedError, nearest
from grounded.frozen import Array
from grounded.model import BELIEVED, Model

Latency = Literal["known", "common", "each"] | Mapping[str, tuple[int, ...]]
LONGEST = 0.5  # [s] largest latency that is fitted
BOUNDS = (
    "to fit a parameter, give bounds, Param(value, unit, low, high), or a prior, "
    "Param(value, unit, std=s)"
)


@dataclass(frozen=True, eq=False)
class Unknowns:
    """theta = [parameters, latencies]: names, bounds, scales, and the mapping to the model.

    The scale is the typical size of a change: the width of the bounds if both are given.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: Array  # (k,)
    low: Array  # (k,) may be -inf
    high: Array  # (k,) may be inf
    scale: Array  # (k,)
    columns: tuple[int, ...]  # indices of the fitted parameters of the model
    delayed: tuple[tuple[int, ...], ...]  # inputs that each fitted latency applies to
    values: Array  # values of all parameters of the model
    latency: Array  # (m,) [s] of all inputs

    @property
    def k(self) -> int:
        """Number of unknowns."""
        return len(self.names)

    def unpack(self, theta: Array) -> tuple[Array, Array]:
        """Return all parameter values and all latencies [s] at theta."""
        p, latency = self.values.copy(), self.latency.copy()
        p[list(self.columns)] = theta[: len(self.columns)]
        for value, inputs in zip(theta[len(self.columns) :], self.delayed, strict=True):
            latency[list(inputs)] = value
        return p, latency

    def less(self, index: int) -> Unknowns:
        """Return the unknowns without one, which stays at its start value."""
        kept = np.delete(np.arange(self.k), index)
        names, units = (tuple(each[i] for i in kept) for each in (self.names, self.units))
        columns = tuple(c for i, c in enumerate(self.columns) if i != index)
        first = len(self.columns)
        delayed = tuple(d for i, d in enumerate(self.delayed, first) if i != index)
        arrays = {key: getattr(self, key)[kept] for key in ("start", "low", "high", "scale")}
        return replace(self, names=names, units=units, columns=columns, delayed=delayed, **arrays)

    def clipped(self, theta: Array) -> Array:
        """Clip theta to the bounds."""
        return np.asarray(np.clip(theta, self.low, self.high))


def unknowns_of(
    model: Model, names: Sequence[str] | None, latency: Array, fit_latency: Latency
) -> Unknowns:
    """Check the names and collect values and bounds.

    Args:
        model: has the values and bounds.
        names: parameters to fit; None for all uncertain ones.
        latency: latency of each input [s], fixed or the start value, (m,).
        fit_latency: "known" (not fitted), "common" (one for all inputs), "each", or the inputs of
            each latency that is fitted, by the name that it gets.

    Raises:
        GroundedError: for a name that is not an uncertain parameter, or nothing to fit.
    """
    names = model.uncertain if names is None else tuple(names)
    for name in names:
        if name not in model.params:
            raise GroundedError(
                f"'{name}' is not a parameter of model '{model.name}': "
                + nearest(name, model.params)
            )
        if not model.params[name].uncertain:
            raise GroundedError(f"'{name}' is a constant of model '{model.name}': {BOUNDS}")
    choices: dict[str, dict[str, tuple[int, ...]]] = {
        "known": {},
        "common": {"latency": tuple(range(model.m))},
        "each": {f"latency:{name}": (j,) for j, name in enumerate(model.input_names)},
    }
    if isinstance(fit_latency, str) and fit_latency not in choices:
        raise GroundedError(f"fit_latency must be known, common or each, got '{fit_latency}'")
    params = [model.params[name] for name in names]
    chosen = choices[fit_latency] if isinstance(fit_latency, str) else dict(fit_latency)
    labels, delayed = list(chosen), list(chosen.values())
    if not names and not labels:
        raise GroundedError(f"model '{model.name}' has no uncertain parameter to fit: {BOUNDS}")
    far = [np.inf if p.std is None else BELIEVED * p.std for p in params]  # if there is no bound
    low = [p.value - f if p.low is None else p.low for p, f in zip(params, far, strict=True)]
    high = [p.value + f if p.high is None else p.high for p, f in zip(params, far, strict=True)]
    low, high = low + [0.0] * len(delayed), high + [LONGEST] * len(delayed)
    start = [p.value for p in params] + [float(latency[inputs[0]]) for inputs in delayed]
    width = np.array(high) - np.array(low)
    size = np.maximum(np.abs(start), 1e-3)
    return Unknowns(
        names=(*names, *labels),
        units=(*(p.unit for p in params), *("s" for _ in delayed)),
        start=np.array(start, float),
        low=np.array(low, float),
        high=np.array(high, float),
        scale=np.where(np.isfinite(width), width, size),
        columns=tuple(model.param_names.index(name) for name in names),
        delayed=tuple(delayed),
        values=np.array(model.values),
        latency=np.array(latency, float),
    )
