"""Effects that are NOT in the library: what the diagnosis must meet without a name for it.

resonance     the actuator rings: u_eff'' = w^2 (u - u_eff) - 2 zeta w u_eff'
asymmetric    a different gain for positive and negative commands
dropouts      commands get lost for 0.1 to 0.4 s; the last one is held
fault         from half of the trial on an actuator gives less
expo          an exponential stick curve: u_eff = (1 - e) u + e u^3 / peak^2
crosstalk     one input leaks, squared, into another
quantised     commands arrive in coarse steps
gusts         pushes of half a second at random times
hysteresis    drag that depends on whether the speed rises or falls
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.challenge.truth import Actuator
from grounded.frozen import Array
from grounded.model import Model

Rate = Callable[[Any, Any, float, Mapping[str, Any]], Mapping[str, float]]


@dataclass(frozen=True, eq=False)
class Withheld:
    """One withheld effect at work."""

    name: str
    target: str
    params: dict[str, float]
    actuators: tuple[Actuator, ...] = ()
    rates: tuple[Rate, ...] = ()


def draw(
    rng: np.random.Generator, model: Model, peak: Array, driven: str, rate: float, duration: float
) -> Withheld:
    """A random withheld effect for a model.

    Args:
        rng: randomness.
        model: the system.
        peak: typical size of each input (m,).
        driven: the state that gusts and hysteresis act on.
        rate: typical size of that state's rate.
        duration: of a trial [s].
    """
    makers = [_resonance, _asymmetric, _dropouts, _fault, _expo, _quantised, _crosstalk]
    kind = int(rng.integers(0, len(makers) + 2))
    j = int(rng.integers(0, model.m))
    if kind == len(makers) or (model.m == 1 and kind == len(makers) - 1):
        return _gusts(rng, driven, rate, duration)
    if kind == len(makers) + 1:
        return _hysteresis(rng, driven, rate)
    return makers[kind](rng, j, model, float(peak[j]), duration)


def _named(name: str, model: Model, j: int, params: dict[str, float], f: Actuator) -> Withheld:
    return Withheld(name, model.input_names[j], params, actuators=(f,))


def _resonance(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    w, zeta = 2 * np.pi * rng.uniform(0.7, 2.0), rng.uniform(0.05, 0.25)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        z, rate = own.get("resonance", (u[j], 0.0))
        rate = rate + dt * (w * w * (u[j] - z) - 2 * zeta * w * rate)
        z = z + dt * rate
        own["resonance"] = (z, rate)
        out = u.copy()
        out[j] = z
        return out

    return _named("resonance", model, j, {"omega": w, "zeta": zeta}, act)


def _asymmetric(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    gain = rng.choice([-1, 1]) * rng.uniform(0.1, 0.4)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        out = u.copy()
        out[j] = u[j] * (1 + gain) if u[j] > 0 else u[j]
        return out

    return _named("asymmetric", model, j, {"gain": float(gain)}, act)


def _dropouts(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    rate = rng.uniform(0.3, 1.0)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        until, held = own.get("dropouts", (-1.0, u))
        if t >= until:
            held = u.copy()
            if own["rng"].random() < rate * dt:
                until = t + own["rng"].uniform(0.1, 0.4)
        own["dropouts"] = (until, held)
        return np.array(held)

    return _named("dropouts", model, j, {"per_second": rate}, act)


def _fault(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    begin, loss = T * rng.uniform(0.4, 0.6), rng.uniform(0.15, 0.5)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        out = u.copy()
        out[j] = u[j] * (1 - loss) if t > begin else u[j]
        return out

    return _named("fault", model, j, {"begin": begin, "loss": loss}, act)


def _expo(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    e = rng.uniform(0.2, 0.7)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        out = u.copy()
        out[j] = (1 - e) * u[j] + e * u[j] ** 3 / peak**2
        return out

    return _named("expo", model, j, {"e": e}, act)


def _quantised(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    size = peak * rng.uniform(0.15, 0.5)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        out = u.copy()
        out[j] = size * np.rint(u[j] / size)
        return out

    return _named("quantised", model, j, {"step": size}, act)


def _crosstalk(rng: np.random.Generator, j: int, model: Model, peak: float, T: float) -> Withheld:
    other = (j + 1) % model.m
    leak = rng.choice([-1, 1]) * rng.uniform(0.1, 0.4)

    def act(u: Array, own: dict[str, Any], t: float, dt: float) -> Array:
        out = u.copy()
        out[j] = u[j] + leak * u[other] ** 2
        return out

    return _named("crosstalk", model, j, {"leak": float(leak)}, act)


def _gusts(rng: np.random.Generator, driven: str, rate: float, T: float) -> Withheld:
    begins = np.sort(rng.uniform(0.1 * T, 0.9 * T, 4))
    sizes = rate * rng.choice([-1, 1], 4) * rng.uniform(0.2, 0.8, 4)

    def push(s: Any, a: Any, t: float, own: Mapping[str, Any]) -> Mapping[str, float]:
        inside = (t > begins) & (t < begins + 0.5)
        return {driven: float(sizes[inside].sum())}

    return Withheld("gusts", driven, {"count": 4.0}, rates=(push,))


def _hysteresis(rng: np.random.Generator, driven: str, rate: float) -> Withheld:
    size = rate * rng.uniform(0.1, 0.4)

    def drag(s: Any, a: Any, t: float, own: Mapping[str, Any]) -> Mapping[str, float]:
        return {driven: -size * float(np.tanh(5 * own[driven] / rate) > 0)}

    return Withheld("hysteresis", driven, {"size": size}, rates=(drag,))
