"""A model's step as a plain function of named values, around which effects are wrapped."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from grounded.compile.names import Named, check_names
from grounded.effects.family import Effect
from grounded.model import Model

Step = Callable[[Any, Any, Any, Any], dict[str, Any]]


def plain_step(model: Model) -> Step:
    """Return the model's step(s, a, p, dt) in named values; a derivative is integrated."""
    stepped, derivative, names = model.step, model.derivative, model.state_names

    def checked(function: Callable[..., Any], *at: Any) -> dict[str, Any]:
        check_names(values := function(*at), names, function)
        return dict(values)

    if stepped is not None:
        return lambda s, a, p, dt: checked(stepped, s, a, p, dt)
    assert derivative is not None

    def moved(s: Any, rates: Mapping[str, Any], by: Any) -> Named:
        return Named("state", names, [s[n] + by * rates[n] for n in names])

    def euler(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        return dict(moved(s, checked(derivative, s, a, p), dt))

    def rk4(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        k1 = checked(derivative, s, a, p)
        k2 = derivative(moved(s, k1, 0.5 * dt), a, p)
        k3 = derivative(moved(s, k2, 0.5 * dt), a, p)
        k4 = derivative(moved(s, k3, dt), a, p)
        return {n: s[n] + dt / 6 * (k1[n] + 2 * k2[n] + 2 * k3[n] + k4[n]) for n in names}

    once = rk4 if model.integrator == "rk4" else euler

    def several(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        for _ in range(model.substeps):
            s = Named("state", names, list(once(s, a, p, dt / model.substeps).values()))
        return dict(s)

    return once if model.substeps == 1 else several


def param_name(effect: str, quantity: str) -> str:
    """Return the parameter name of a quantity: `dead_zone_throttle_c` for `dead_zone:throttle`."""
    family, _, targets = effect.partition(":")
    return f"{family}_{targets.replace('+', '_').replace('<-', '_from_')}_{quantity}"


def quantities_of(effect: Effect, p: Any) -> dict[str, Any]:
    """Return an effect's quantities from the parameters of the wrapped model."""
    return {q.name: p[param_name(effect.name, q.name)] for q in effect.quantities}


def own_state(model: Model, s: Any, true: Mapping[str, str] | None = None) -> Named:
    """Return the model's states; `true` maps a logged state to the memory with its true value."""
    values = [s[(true or {}).get(n, n)] for n in model.state_names]
    return Named("state", model.state_names, values)
