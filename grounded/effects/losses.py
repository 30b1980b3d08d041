"""A step with losses of joints, solved implicitly within the step.

Over a step of h

    w_free            speed w at the end of the step without the loss
    B = d w / d tau   what a unit of tau, held over the step, adds to it
    w_end = w_free - B T                                                    T: mean loss in the step

The equation w' = (w_free - w) / h - B T(w) / h is solved for this one speed, in a few implicit
parts of the step, with everything else constant over the step. A dry friction slows a joint until
it stops, holds it while the other torques are less than c, and otherwise lets it move the other way
for the rest of the step; it can't be too stiff for a step. It builds up over a width of speed, a
hundredth of the largest speed or a fitted value, never as wide as a viscous friction. Losses of
several joints are coupled by B (k, k) and solved by a few Gauss-Seidel sweeps.

The mean T, held over the step, gives the correct w at the end, but not the correct positions: a
loss that grows within the step takes off less early and more late. With T_1, the mean over the
first half, and a loss that grows linearly, each position q' = c w is ahead by

    c h B (T - T_1) / 3                                              (`ahead`)

That is a hundredth of the motion in a step. Without it, a delay estimated from positions is half a
millisecond too short.

A diagnosis solves this hundreds of thousands of times for a few hundred rows, so arrays are handled
by compiled code if the functions of the families can be compiled.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from grounded.compile import system_of
from grounded.compile.names import Named
from grounded.effects.drive import push, speed
from grounded.effects.family import Effect, LossFamily, coupled
from grounded.effects.plain_step import param_name
from grounded.frozen import Array

if TYPE_CHECKING:
    from grounded.compile.run.interpreted import System

SWEEPS = 3
PARTS = 4  # implicit parts of a step
NUDGE = 1e-2  # finite-difference step for B, in the input's unit
NONE = np.zeros(0)

Pairs = Sequence[tuple[Effect, Mapping[str, Any]]]
Weights = Sequence[Mapping[str, Any]]  # of velocities in the speed of each pair
Left = tuple[Array, dict[str, Array]]  # inputs (..., m) after losses, and terms of positions
Integrated = Mapping[str, tuple[str, float]]  # {position: (its velocity, factor)}
Losses = tuple[Callable[..., Any], ...]


def memory_name(effect: Effect, name: str) -> str:
    """Return the name of a loss' memory among the states of a model that has the loss."""
    return param_name(effect.name, name)


class Loads(NamedTuple):
    """The quantities from which losses are solved, one entry per pair (effect, values)."""

    w: Sequence[Any]  # speed at the start
    free: Sequence[Any]  # speed at the end without a loss
    gain: Sequence[Sequence[Any]]  # B [w][tau]
    u: Sequence[Any]  # the input
    answers: Sequence[Mapping[str, Any]]  # what a unit of the input adds to each state


def step_with(
    pairs: Pairs,
    s: Any,
    a: Named,
    dt: Any,
    steps: tuple[Callable[[Named], Any], Callable[[Named], Any]],
    moved: Integrated,
) -> dict[str, Any]:
    """Return the next state by name under losses of the inputs `a`.

    steps: step(a) -> next state; the same where inputs are held over it, to solve the losses from.
    """
    (step, held), given = steps, dict(a)
    at = loads(pairs, s, a, held)
    losses = solved(pairs, at, dt)
    for (effect, _), loss in zip(pairs, losses, strict=True):
        name = coupled(effect.site)[0]
        given[name] = given[name] - loss
    after = dict(step(Named("input", tuple(given), list(given.values()))))
    more = ahead(pairs, at, losses, dt, moved)
    after |= {q: after[q] + by for q, by in more.items()}
    return after | remembered(pairs, s, after, a, dt)


def remembered(pairs: Pairs, s: Any, after: Any, a: Any, dt: Any) -> dict[str, Any]:
    """Return the memories of losses by name after a step from s to `after`; `pairs` has those of s.

    They follow from how the speeds went, whatever moved them. What a unit of the input adds to a
    speed is a median: it only tells how the speed went within the step.
    """
    found = dict[str, Any]()
    for effect, c in pairs:
        if names := _family(effect).memory(effect.site):
            gain = push(effect.site.model, effect.site.joined) * dt
            ends, u = (speed(effect, s), speed(effect, after)), a[coupled(effect.site)[0]]
            kept = _family(effect).later(*ends, gain, u, c, dt)
            found |= {memory_name(effect, name): kept[name] for name in names}
    return found


def loads(
    pairs: Pairs, s: Any, a: Named, step: Callable[[Named], Any], weights: Weights | None = None
) -> Loads:
    """Return what the losses of a step are solved from; step(a) -> next state by name."""
    free, found = step(a), dict[str, dict[str, Any]]()
    for name in dict.fromkeys(coupled(effect.site)[0] for effect, _ in pairs):
        more = [a[n] + NUDGE if n == name else a[n] for n in a]
        reached = step(Named("input", tuple(a), more))
        found[name] = {n: (reached[n] - free[n]) / NUDGE for n in free}
    return loads_from(pairs, s, a, free, found, weights)


def loads_from(
    pairs: Pairs,
    s: Any,
    a: Mapping[str, Any],
    free: Any,
    answers: Mapping[str, Any],
    weights: Weights | None = None,
) -> Loads:
    """Return the same from the state after a step without losses, and its slopes by the inputs.

    weights: of the velocities in each loss' speed; None: those of its own model.
    """
    given: Sequence[Mapping[str, Any] | None] = weights or [None] * len(pairs)
    effects = [(effect, own) for (effect, _), own in zip(pairs, given, strict=True)]
    inputs = [coupled(effect.site)[0] for effect, _ in effects]
    gain = [[speed(effect, answers[tau], own) for tau in inputs] for effect, own in effects]
    speeds, ends = ([speed(effect, x, own) for effect, own in effects] for x in (s, free))
    taken, own = [a[tau] for tau in inputs], [answers[tau] for tau in inputs]
    return Loads(speeds, ends, gain, taken, own)


def solved(pairs: Pairs, at: Loads, dt: Any) -> list[Any]:
    """Return the mean loss of each pair over a step of dt."""
    losses, values = tuple(_family(effect).loss for effect, _ in pairs), [v for _, v in pairs]
    if (found := _compiled(losses, values, at, (), dt)) is not None:
        return found
    return _swept(losses, values, at, dt)


def _swept(losses: Losses, values: Sequence[Mapping[str, Any]], at: Loads, dt: Any) -> list[Any]:
    """Solve the losses in NumPy by Gauss-Seidel sweeps."""
    count = len(losses)
    found: list[Any] = [0.0] * count
    for _ in range(SWEEPS if count > 1 else 1):
        for i in range(count):
            found[i] = _beside(losses, values, at, found, i, dt)
    return found


def _beside(
    losses: Losses,
    values: Sequence[Mapping[str, Any]],
    at: Loads,
    found: Sequence[Any],
    i: int,
    dt: Any,
) -> Any:
    """Return the mean loss of one pair, given the current losses of the others."""
    rest, own = at.free[i], np.maximum(np.abs(at.gain[i][i]), 1e-12)
    for j, other in enumerate(found):
        if j != i:
            rest = rest - at.gain[i][j] * other
    return losses[i](at.w[i], rest, own, at.u[i], values[i], dt)


def ahead(
    pairs: Pairs, at: Loads, losses: Sequence[Any], dt: Any, moved: Integrated
) -> dict[str, Any]:
    """Return what positions (`moved`) gain in a step over a step with the mean losses held."""
    half = at._replace(
        free=[0.5 * (start + end) for start, end in zip(at.w, at.free, strict=True)],
        gain=[[0.5 * by for by in row] for row in at.gain],
    )
    families = [_family(effect) for effect, _ in pairs]
    means, values = tuple(one.early or one.loss for one in families), [v for _, v in pairs]
    early = _compiled(means, values, half, losses, 0.5 * dt)
    if early is None:
        early = [_beside(means, values, half, losses, i, 0.5 * dt) for i in range(len(pairs))]
    found = dict[str, Any]()
    for mean, first, answer in zip(losses, early, at.answers, strict=True):
        later = dt / 3 * (mean - first)
        for q, (w, c) in moved.items():
            found[q] = found.get(q, 0.0) + c * answer[w] * later
    return found


def _family(effect: Effect) -> LossFamily:
    assert isinstance(effect.family, LossFamily)
    return effect.family


def _compiled(
    losses: Losses,
    values: Sequence[Mapping[str, Any]],
    at: Loads,
    found: Sequence[Any],
    dt: Any,
) -> list[Any] | None:
    """Solve the losses of arrays with compiled code; None for other types, or without a compiler.

    `found`: current mean losses, beside which each is solved once; empty: solve all.
    """
    free = at.free[0]
    if not (isinstance(free, np.ndarray) and free.dtype == np.float64):
        return None
    kernel = _kernel(losses, tuple(tuple(sorted(own)) for own in values), bool(found))
    if kernel is None:
        return None
    gains = [by for row in at.gain for by in row]
    numbers = [own[name] for own in values for name in sorted(own)]
    given = [*at.free, *at.u, *gains, *numbers, *found]
    shape = np.broadcast_shapes(*{np.shape(value) for value in (*at.w, *given)})
    x, u = np.empty((*shape, len(losses))), np.empty((*shape, len(given)))
    for into, columns in ((x, at.w), (u, given)):
        for i, value in enumerate(columns):
            into[..., i] = value
    rows = kernel.step(x.reshape(-1, len(losses)), u.reshape(-1, len(given)), NONE, float(dt))
    after = rows.reshape(x.shape)
    return [after[..., i] for i in range(len(losses))]


@cache
def _kernel(losses: Losses, names: tuple[tuple[str, ...], ...], known: bool) -> System | None:
    """Compile the losses of many rows, as a step of the speeds; None if that fails."""
    pairs = range(len(losses))
    quantities = [[f"{name}_{i}" for name in own] for i, own in enumerate(names)]
    gains = [[f"gain_{i}_{j}" for j in pairs] for i in pairs]
    free, u, means = ([f"{letter}_{i}" for i in pairs] for letter in ("free", "u", "mean"))

    def step(s: Any, a: Any, p: Any, dt: Any) -> dict[str, Any]:
        values = [
            {name: a[key] for name, key in zip(own, keys, strict=True)}
            for own, keys in zip(names, quantities, strict=True)
        ]
        gain = [[a[key] for key in row] for row in gains]
        at = Loads([s[f"w_{i}"] for i in pairs], [a[k] for k in free], gain, [a[k] for k in u], ())
        if known:
            given = [a[key] for key in means]
            found = [_beside(losses, values, at, given, i, dt) for i in pairs]
        else:
            found = _swept(losses, values, at, dt)
        return {f"w_{i}": found[i] for i in pairs}

    inputs = [*free, *u, *chain(*gains, *quantities), *(means if known else ())]
    states = [f"w_{i}" for i in pairs]
    system = system_of(
        step, kind="step", states=states, inputs=inputs, params=(), derivatives=False
    )
    return system if system.how in ("compiled", "compiled steps") else None


def dry(w: Any, free: Any, gain: Any, c: Any, b: Any, width: Any, parts: int = PARTS) -> Any:
    """Return the mean of c clip(w / width, -1, 1) + b w over a step that would end at `free`.

    The first term uses the implicit Euler method, the second the trapezoidal rule, so that the end
    of each part is known in closed form.
    """
    part = gain / parts
    push, by = (free - w) / parts, np.maximum(1 + 0.5 * part * b, 0.1)
    g = part * c / by
    total: Any = 0.0
    for _ in range(parts):
        end = (w + push - 0.5 * part * b * w) / by
        slow, fast = end / (1 + g / width), np.maximum(np.abs(end) - g, 0.0)
        last = np.where(np.abs(slow) < width, slow, np.where(end > 0, fast, -fast))
        dry = np.minimum(np.maximum(last / width, -1.0), 1.0)
        total = total + c * dry + 0.5 * b * (w + last)
        w = last
    return total / parts
