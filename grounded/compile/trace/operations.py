"""The operations a graph is made of, and what each means on NumPy arrays.

Indicator terms are smoothed by a width eps known only when the graph runs; eps = 0 means exactly
the branch that the user wrote:

    above(l, r)      1 where l > r, else 0          logistic((l - r) / eps)
    blend(w, a, b)   a where w = 1, b where w = 0    w a + (1 - w) b
    abs(x)           |x|                             sqrt(x^2 + eps^2)
    max(a, b)        the larger                      (a + b + sqrt((a - b)^2 + eps^2)) / 2
    sign(x)          -1, 0, 1                        x / sqrt(x^2 + eps^2)

A condition is a weight in [0, 1], so that "and", "or", "not" are w v, w + v - w v and 1 - w.
A NaN or infinity on a branch that is not taken never reaches the result. The last operations
(`slope`, `side`, `bend`, `gate`) only occur in derivatives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

SATURATED = 40.0  # logistic(40) = 1 to the last bit


def above(eps: float, left: Any, r: Any) -> Any:
    """Weight of l > r."""
    if eps == 0.0:
        return np.greater(left, r).astype(float)
    with np.errstate(all="ignore"):
        d = (left - r) / eps
        w = 1.0 / (1.0 + np.exp(-np.clip(d, -SATURATED, SATURATED)))
    w = np.where(d > SATURATED, 1.0, np.where(d < -SATURATED, 0.0, w))
    return np.where(np.isnan(d), np.greater(left, r).astype(float), w)


def blend(eps: float, w: Any, a: Any, b: Any) -> Any:
    """Weighted mean of a and b; the heavier one where the mean is not finite."""
    with np.errstate(all="ignore"):
        mixed = w * a + (1.0 - w) * b
    pure = np.where(np.asarray(w) >= 0.5, a, b)
    return np.where((w > 0.0) & (w < 1.0) & np.isfinite(mixed), mixed, pure)


def absolute(eps: float, x: Any) -> Any:
    """Smoothed absolute value."""
    return np.abs(x) if eps == 0.0 else np.sqrt(x * x + eps * eps)


def sign(eps: float, x: Any) -> Any:
    """Smoothed sign; also the derivative of `absolute`."""
    return np.sign(x) if eps == 0.0 else x / np.sqrt(x * x + eps * eps)


def bend(eps: float, x: Any) -> Any:
    """Derivative of `sign`."""
    if eps == 0.0:
        return np.zeros_like(x)
    q = x * x + eps * eps
    return eps * eps / (q * np.sqrt(q))


def maximum(eps: float, a: Any, b: Any) -> Any:
    """Smoothed maximum; exact where a bound is infinite."""
    sharp = np.where(np.greater(a, b), a, b)
    if eps == 0.0:
        return sharp
    d = a - b
    soft = 0.5 * (a + b + np.sqrt(d * d + eps * eps))
    return np.where(np.isfinite(soft), soft, sharp)


def side(eps: float, a: Any, b: Any) -> Any:
    """Share of a in the maximum, its derivative with respect to a."""
    if eps == 0.0:
        return 0.5 * (1.0 + np.sign(a - b))
    d = a - b
    soft = 0.5 * (1.0 + d / np.sqrt(d * d + eps * eps))
    return np.where(np.isfinite(soft), soft, np.greater(a, b).astype(float))


def slope(eps: float, w: Any) -> Any:
    """Derivative of `above` with respect to l, from its value."""
    return np.zeros_like(w) if eps == 0.0 else w * (1.0 - w) / eps


def gate(eps: float, x: Any, y: Any) -> Any:
    """The product x y, and 0 where x is 0 or the product is not finite."""
    product = x * y
    return np.where((np.asarray(x) != 0.0) & np.isfinite(product), product, 0.0)


def equal(eps: float, left: Any, r: Any) -> Any:
    """1 where equal; never smoothed."""
    return np.equal(left, r).astype(float)


# Operations that are a NumPy function and no more, by their names there.
PLAIN = {
    **{name: name for name in ("sqrt", "cbrt", "exp", "expm1", "log", "log1p", "sin", "cos")},
    **{name: name for name in ("tan", "sinh", "cosh", "tanh", "floor", "rint", "trunc")},
    **{"add": "add", "sub": "subtract", "mul": "multiply", "div": "divide", "neg": "negative"},
    **{"pow": "power", "asin": "arcsin", "acos": "arccos", "atan": "arctan", "atan2": "arctan2"},
}


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda eps, *args: function(*args)


NUMPY: dict[str, Callable[..., Any]] = {
    **{op: _plain(getattr(np, name)) for op, name in PLAIN.items()},
    "above": above,
    "equal": equal,
    "blend": blend,
    "abs": absolute,
    "sign": sign,
    "max": maximum,
    "side": side,
    "bend": bend,
    "slope": slope,
    "gate": gate,
}
SMOOTHED = frozenset({"above", "abs", "sign", "max", "side", "bend", "slope"})  # depend on eps
