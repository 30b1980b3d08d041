"""Values of the memory states of adopted effects, at the start of a trial and along it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from grounded.compile.names import Named
from grounded.effects.family import InputFamily, LossFamily, MemoryFamily, coupled
from grounded.effects.plain_step import adopted, param_name, quantities_of
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import true_values
from grounded.trial import Trial

FOLLOWS = 0.4  # of what the model misses of a log in a step, by which the true values follow


def settled(model: Model, a: Named, p: Named) -> dict[str, Any]:
    """Return the settled memories under constant inputs a, by `input_family` or state.

    Each effect passes its output on to those inside it.
    """
    found = dict[str, Any]()
    for effect in adopted(model):
        family, own = effect.family, {}
        if isinstance(family, MemoryFamily):
            own = {f"{n}_{family.name}": a[n] for n in effect.site.targets}
        elif isinstance(family, InputFamily):
            c = quantities_of(effect, p)
            sent = {n: family.effect(a[n], 0.0, c) for n in effect.site.targets}
            a = Named("input", tuple(a), [sent.get(n, a[n]) for n in a])
        elif isinstance(family, LossFamily) and family.memory(effect.site):
            rest = family.rest(a[coupled(effect.site)[0]], quantities_of(effect, p))
            own = {param_name(effect.name, z): value for z, value in rest.items()}
        found = own | found
    return found


def part_of(steps: Any) -> Any:
    """Return by how much a delay of some steps is longer than whole ones, 0 to 1."""
    return np.maximum(steps - np.floor(steps + 1e-9), 0.0)


def shifted(signal: Array, held: Array, steps: float) -> Array:
    """Delay a zero-order-hold signal (S, T) by any number of steps; return its mean over each."""
    (now, before), part = _both(signal, held, steps), float(part_of(steps))
    return (1 - part) * now + part * before


class Sent(NamedTuple):
    """A signal that may change within its steps.

    A lead is how much more arrives early in a step than late, the mean of (1/2 - t/dt) u(t) over
    it; 0 for what is constant.

    Attributes:
        mean: over each step (S, T).
        held: the value before the first step (S,).
        lead: of each step (S, T).
        early: mean over the first part of each step (S, T).
        early_lead: lead within this part (S, T).
    """

    mean: Array
    held: Array
    lead: Array
    early: Array
    early_lead: Array


def shifted_within(sent: Sent, steps: float) -> tuple[Array, Array]:
    """Delay a signal by any number of steps; return its mean and its lead in each (S, T).

    A part p of a step brings the last part p of the step before, and the first part 1 - p of this
    one, which `sent.early` has. With means of whole steps instead, the delay of a lag's output acts
    as a further lag, and the lag itself was estimated short by p (1 - p) dt^2 / (2 tau).
    """
    p = float(part_of(steps))
    q = 1 - p
    first, own = q * sent.early, 0.5 * p * q * sent.held  # integrals, in steps
    moment = q * q * sent.early_lead + 0.5 * p * first
    now, before = _both(first, q * sent.held, steps)
    moment_now, moment_before = _both(moment, own, steps)
    _, mean_before = _both(sent.mean, sent.held, steps)
    _, lead_before = _both(sent.lead, 0 * sent.held, steps)
    rest = mean_before - before
    return now + rest, moment_now - p * now + lead_before - moment_before + q * rest


def _both(signal: Array, held: Array, steps: float) -> tuple[Array, Array]:
    """Return a signal (S, T) after the whole steps of a delay, and after one more."""
    whole = int(np.floor(steps + 1e-9))
    line = np.concatenate([np.repeat(held[:, None], whole + 1, axis=1), signal], axis=1)
    T = signal.shape[1]
    return line[:, 1 : T + 1], line[:, :T]


def late_inputs(inputs: Array, held: Array, latency: Array, dt: float) -> Array:
    """Return inputs (S, T, m) after a latency (m,) [s], with `held` (S, m) before them."""
    if not latency.any():
        return inputs
    each = [shifted(inputs[:, :, j], held[:, j], d / dt) for j, d in enumerate(latency.tolist())]
    return np.stack(each, axis=2)


def memory_of(wrapped: Model, base: Model, trial: Trial, latency: Array | None = None) -> Array:
    """Return the memory states along a recorded trial, (T + 1, wrapped.n - base.n).

    They start at `memory_start` and follow the logged states and the received commands, which come
    by `latency` (m,) [s] late. True values behind late or filtered logs would drift away from these
    where they are integrals (a heading, a place), since a crude model misses their rates. So they
    follow their logs: what the model misses of a log moves its true values by FOLLOWS of it, as an
    observer does (Luenberger 1964).
    """
    inputs = trial.inputs
    if latency is not None:
        held = np.zeros(base.m) if trial.start_inputs is None else trial.start_inputs
        inputs = late_inputs(inputs[None], held[None], latency, trial.dt)[0]
    found = [now := memory_start(wrapped, base, trial)]
    behind = true_values(wrapped.state_names, wrapped.state_names[base.n :])
    memories, logged = np.array([*behind], int) - base.n, np.array([*behind.values()], int)
    for t in range(trial.steps):
        x = np.concatenate([trial.states[t], now])[None]
        after = wrapped.system.step(x, inputs[t][None], wrapped.values, trial.dt)
        now = after[0, base.n :]
        if behind:
            missed = base.difference(trial.states[t + 1], after[0, : base.n])[logged]
            now[memories] += FOLLOWS * np.where(np.isfinite(missed), missed, 0.0)
        found.append(now)
    return np.array(found).reshape(trial.steps + 1, wrapped.n - base.n)


def memory_start(wrapped: Model, base: Model, trial: Trial) -> Array:
    """Return the memory states at t = 0, (wrapped.n - base.n,).

    A clock starts at 0, a true value behind a delayed log at the log. Memories of inputs start
    settled at the held inputs, after the input effects that act before them.
    """
    held = np.zeros(base.m) if trial.start_inputs is None else trial.start_inputs
    inputs = Named("input", base.input_names, list(held))
    params = Named("parameter", wrapped.param_names, list(wrapped.values))
    known = settled(wrapped, inputs, params)
    names, n = wrapped.state_names, base.n
    start = [float(known.get(z, known.get(z.rpartition("_")[0], 0.0))) for z in names[n:]]
    for memory, logged in true_values(names, names[n:]).items():
        start[memory - n] = float(trial.states[0, logged])
    return np.array(start)
