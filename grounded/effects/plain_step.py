"""A model's step as a plain function of named values, around which effects are wrapped."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from grounded.compile.names import Named, check_names
from grounded.effects.family import Effect, Family, InputFamily, MemoryFamily, Values
from grounded.model import Model

Step = Callable[[Any, Any, Any, Any], dict[str, Any]]


def plain_step(model: Model) -> Step:
    """Return the model's step(s, a, p, dt) in named values; a derivative is integrated."""
    whole = model.whole

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        each = ((s, whole.states), (a, whole.inputs), (p, whole.params))
        x, u, values = ([of[name] for name in names] for of, names in each)
        after = whole.call(x, u, values, dt)
        check_names(after, whole.states, whole.function)
        return dict(after)

    return step


@dataclass(frozen=True)
class Around:
    """What the step of a model with adopted effects is around.

    Args:
        inner: the model without them.
        effects: those that act together, several rates or several losses; else a single one.
        values: quantities of the last one, as they were wrapped.
        dt: control step [s].
    """

    inner: Model
    effects: tuple[Effect, ...]
    values: Values
    dt: float

    @property
    def of_inputs(self) -> bool:
        """Whether the effect acts on inputs."""
        return isinstance(self.effects[-1].family, InputFamily | MemoryFamily)


def around(model: Model) -> Around | None:
    """Return the outermost adopted effects of a model, None if there are none."""
    found = getattr(model.step, "around", None)
    return found if isinstance(found, Around) else None


def adopted(model: Model) -> Iterator[Effect]:
    """Yield the adopted effects of a model, the outermost first."""
    while (found := around(model)) is not None:
        yield from reversed(found.effects)
        model = found.inner


def joined(model: Model, kind: type[Family]) -> tuple[Model, tuple[Effect, ...]]:
    """Return the model inside its outermost effects if they are of a kind, and these effects."""
    found = around(model)
    same = found is not None and isinstance(found.effects[-1].family, kind)
    return (found.inner, found.effects) if found is not None and same else (model, ())


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
