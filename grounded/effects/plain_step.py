"""A model's step in the user's own words: what effects are wrapped around."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from grounded.compile.names import Named, check_names
from grounded.effects.family import Effect
from grounded.model import Model

Step = Callable[[Any, Any, Any, Any], dict[str, Any]]


def plain_step(model: Model) -> Step:
    """The model's step(s, a, p, dt) in the user's own words, integrating a derivative."""
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
    """`dead_zone_throttle_c`: the wrapped model's name of a quantity of `dead_zone:throttle`."""
    family, _, targets = effect.partition(":")
    return f"{family}_{targets.replace('+', '_').replace('<-', '_from_')}_{quantity}"


def quantities_of(effect: Effect, p: Any) -> dict[str, Any]:
    """An effect's numbers among the parameters of the model that it joined."""
    return {q.name: p[param_name(effect.name, q.name)] for q in effect.quantities}


def own_state(model: Model, s: Any, true: Mapping[str, str] | None = None) -> Named:
    """The model's states; `true`: the memory that stands for one that is only logged."""
    values = [s[(true or {}).get(n, n)] for n in model.state_names]
    return Named("state", model.state_names, values)
