"""Predictions of a hypothesis: the model with effects at given values and its parameters shifted.

    x_{t+1} = f_h(x_t, commands)        y_t = x_t + offset_h(x)

Effects on inputs transform the command sequence of the whole trial. Losses of a joint reduce the
input received in a step. Added rates act by Strang splitting, half before and half after the
model's step; limits of rates act on its mean rate. Sensor effects change the output that is
compared with the log. The equations are those of `grounded.effects.wrap`, evaluated on arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from hashlib import blake2b
from typing import Any

import numpy as np

from grounded.compile import Named
from grounded.diagnosis.likelihood import joint_memory
from grounded.diagnosis.likelihood.arriving import (
    Acting,
    arriving,
    delayed,
    memories_moved,
    within_steps,
)
from grounded.diagnosis.likelihood.cache import Cache
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import filter_lag, sensor_offset
from grounded.diagnosis.likelihood.hypothesis import (
    Hypothesis,
    adds_to_steps,
    by_row,
)
from grounded.diagnosis.likelihood.marching import March
from grounded.diagnosis.likelihood.memories import recalled
from grounded.diagnosis.likelihood.moving import moving
from grounded.diagnosis.likelihood.simulated import Slopes, simulated
from grounded.effects import (
    Effect,
    ParamFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
)
from grounded.effects.drive import weights_at
from grounded.effects.family import braked, coupled
from grounded.effects.losses import Left, Loads, ahead, loads, loads_from, solved
from grounded.effects.medium import medium_of, through_it
from grounded.effects.plain_step import adopted, quantities_of
from grounded.effects.sensed import behind_logs, logged, moved_model, seen_names
from grounded.engine import Shared
from grounded.frozen import Array
from grounded.places import integrated, outright_states, partner
from grounded.rollout import each_stepped, equal_rows

TOGETHER = 6000  # rows of states that are stepped at once


@dataclass(frozen=True, eq=False)
class Predictor(Shared):
    """Evaluate hypotheses on one `Data`. Shapes: tracks (L + 1, B, n), inputs (L, B, m)."""

    data: Data
    _inputs: dict[str, Cache] = field(default_factory=dict)
    _steps: Cache = field(default_factory=lambda: Cache(16))  # of a simulator
    _loads: Cache = field(default_factory=lambda: Cache(32_000))
    _remembered: Cache = field(default_factory=lambda: Cache(400_000, least=8))
    _weights: dict[str, Cache] = field(default_factory=dict)
    marches: dict[Any, March | None] = field(default_factory=dict)
    _taken: Slopes | None = None

    @cached_property
    def taken(self) -> Slopes:
        """The cache of a simulator's slopes."""
        model, scales = self.data.model, self.data.scales
        spreads = np.array([scales.spread(n) for n in model.state_names])
        peaks = np.array([scales.peak(n) for n in model.input_names])
        return self._taken or Slopes((spreads, peaks, np.abs(model.values) + model.spreads))

    def following(self) -> Predictor:
        """Return a predictor whose caches follow one hypothesis' track, if a simulator; or self."""
        if not simulated(self.data.model):
            return self
        return replace(self, _taken=self.taken.following(), _loads=Cache(self._loads.most))

    def inputs(self, h: Hypothesis) -> Array:
        """Return the inputs that the actuators receive under a hypothesis, by run (L, B, m).

        If they may change within a step, m more columns say by how much they lead
        (`MemoryFamily.lead`); single steps then add what that changes (`_within`).
        """
        acting, data = h.acting, self.data
        leads = self._led_by(acting)

        def make() -> Array:
            received = [self._input(acting, j, leads=leads) for j in range(data.model.m)]
            return np.stack([one[k] for k in range(1 + leads) for one in received], axis=-1)

        return self._kept("inputs", acting, make)

    def _input(self, acting: Acting, j: int, *, leads: bool) -> Array:
        """Return one of `inputs` (1 or 2, L, B); cached, since most effects act on few inputs."""
        name, data = self.data.model.input_names[j], self.data
        on_it = [one for one in acting if name in one[0].site.targets]

        def make() -> Array:
            whole = arriving(on_it, data, j, leads=leads)
            return np.stack([data.runs_in_use(one) for one in whole])

        return self._kept(f"input {j} {leads}", on_it, make)

    def received(self, h: Hypothesis, *, leads: bool = False) -> Array:
        """Return the received inputs of whole trials, (S, T_max, m); zero if no run is kept.

        leads: add the m columns that `inputs` adds, if there are any.
        """
        acting, data = h.acting, self.data
        leads = leads and self._led_by(acting)

        def make() -> Array:
            m = data.model.m
            whole = np.zeros((*data.commands.shape[:2], m * (1 + leads)))
            for j in range(m):
                own = arriving(acting, data, j, leads=leads)
                whole[data.used, :, j::m] = np.moveaxis(own, 0, -1)
            return whole

        return self._kept(f"trials {leads}", acting, make)

    def _led_by(self, acting: Acting) -> bool:
        """Check whether inputs may change within a step, and whether that matters."""
        return (self.divisible or bool(self.positions)) and within_steps(acting, self.data)

    @cached_property
    def divisible(self) -> bool:
        """Whether a step of the model may be made in parts.

        Not a simulator's, nor if it moves a queue of late inputs on by one, nor if states are set
        outright: those would show the last part alone.
        """
        model = self.data.model
        queued = any(getattr(effect.family, "transport", False) for effect in adopted(model))
        return not (simulated(model) or queued or outright_states(model))

    def begun(self, h: Hypothesis) -> Array | None:
        """Return what effects on inputs add to the initial memory states, by run (B, n).

        None if the model has no memory states or the hypothesis no effects on inputs.
        """
        if not (self.data.hidden and h.acting):
            return None
        acting = h.acting
        return self._kept("begun", acting, lambda: memories_moved(acting, self.data))

    def remembered(self, h: Hypothesis, track: Array) -> Array:
        """Return a track (L + 1, B, n) with exact memories of the inputs that h makes received."""
        data, p = self.data, self.params(h)
        if not data.exact:
            return track

        def make() -> Array:
            path = recalled(data.model, data.exact, self.received(h), p, data.dt)
            whole = zip(path, data.lengths, strict=True)
            flat = np.concatenate([own[: T + 1] for own, T in whole])
            return np.asarray(flat[data.state_at.T])

        found = track.copy()
        found[..., data.exact] = self._kept("memories", h.acting, make, p.tobytes())
        return found

    def _kept(
        self, what: str, acting: Acting, make: Callable[[], Array], beside: bytes = b""
    ) -> Array:
        """Return the cached result for the same effects and values (and `beside`), or make it."""
        found = self._inputs.setdefault(what, Cache(4_000_000, least=64))
        values = tuple((e.name, tuple(sorted(v.items()))) for e, v in acting)
        return found.made((beside, *values), make)

    def params(self, h: Hypothesis) -> Array:
        """Return the model's parameters under a hypothesis (k,), or per row (M, k)."""
        p = np.array(self.data.model.values)
        if h.shift is not None:
            p = p + h.shift
        names = self.data.model.param_names
        for effect, values in h.pairs:
            if isinstance(effect.family, ParamFamily):
                k, d = names.index(effect.site.target), np.asarray(values["d"])
                p = np.broadcast_to(p, (*(d.shape or p.shape[:-1]), len(names))).copy()
                p[..., k] += d
        return p

    def step(self, x: Array, u: Array, p: Array, dt: float | None = None) -> Array:
        """Return the model's own step, any leading shape; with p (M, k), each row has its own."""
        rows, system = self.flat(x, u), self.data.model.system
        if p.ndim > 1:
            own = np.repeat(p, len(rows[0]) // max(1, len(p)), axis=0)
            moved = each_stepped(self.data.model, *rows, own, dt or self.data.dt)
            return moved.reshape(x.shape)
        if not simulated(self.data.model):
            return system.step(*rows, p, dt or self.data.dt).reshape(x.shape)
        parts = (*rows, p, np.array(dt or self.data.dt))  # a simulator is slow and losses ask again
        key = blake2b(b"".join(part.tobytes() for part in parts)).digest()
        found = self._steps.made(key, lambda: system.step(*rows, p, dt or self.data.dt), 1)
        return found.reshape(x.shape).copy()

    def slopes(self, x: Array, u: Array, p: Array, dt: float | None = None) -> tuple[Array, Array]:
        """Return slopes of the model's own step: f_x (..., n, n), f_u (..., n, m)."""
        system = self.data.model.system

        def take(x: Array, u: Array) -> tuple[Array, ...]:
            return system.linearise(x, u, p, dt or self.data.dt)

        if dt is None and simulated(self.data.model):
            found = self.taken.at(take, *self.flat(x, u), p, False)
        else:
            found = take(*self.flat(x, u))
        f_x, f_u = (f.reshape(*x.shape, f.shape[-1]) for f in found)
        return f_x, f_u

    def flat(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return states (..., n) and inputs (..., m) as rows."""
        n, m = self.data.model.n, self.data.model.m
        u = u[..., :m]  # without leads
        return np.ascontiguousarray(x.reshape(-1, n)), np.ascontiguousarray(u.reshape(-1, m))

    def next(self, h: Hypothesis, x: Array) -> Array:
        """Return one step of a hypothesis from each x (L, B, n) of the track, (L, B, n)."""
        return self.advance(h, x, self.inputs(h), self.data.time)

    def each_next(self, hypotheses: Sequence[Hypothesis], track: Array) -> Array:
        """Return a step of each of K hypotheses with the same effects along a track, (K, L, B, n).

        They are the rows of one array, as many as fit into the cache: for short logs, calls take
        longer than what they compute.

        Args:
            hypotheses: the hypotheses.
            track: (L + 1, B, n), its exact memories replaced by those of each hypothesis.
        """
        data = self.data
        x = [self.remembered(h, track)[:-1] for h in hypotheses]
        u = [self.inputs(h) for h in hypotheses]
        found, rows = np.empty((len(x), *data.time.shape, data.model.n)), data.time.size
        most = 1 if simulated(data.model) else max(1, TOGETHER // rows)
        for some in (range(at, min(at + most, len(x))) for at in range(0, len(x), most)):
            own = by_row([hypotheses[i] for i in some], np.repeat(range(len(some)), rows))
            if len(some) == 1:
                found[some[0]] = self.advance(own, x[some[0]], u[some[0]], data.time)
                continue
            starts = np.concatenate([self.widened(hypotheses[i], x[i]) for i in some])
            sent = np.concatenate([u[i] for i in some])
            starts, sent = (a.reshape(-1, a.shape[-1]) for a in (starts, sent))
            after = self.advance(own, starts, sent, np.tile(data.time.reshape(-1), len(some)))
            found[some] = after[:, : data.model.n].reshape(len(some), *found.shape[1:])
        return found

    def advance(self, h: Hypothesis, x: Array, u: Array, t: Array) -> Array:
        """Return one step of a hypothesis from x (..., n) with received u (..., m) at times t.

        Columns behind the states are the memories of its joints, which go on, too. Without them
        x (L, B, n) is a track, along which they are known (`joint_memory`).
        """
        n = self.data.model.n
        if x.shape[-1] > n:
            x, now = x[..., :n], joint_memory.at(h, x[..., n:])
            reached = self.advance(now, x, u, t)
            return np.concatenate([reached, joint_memory.after(self, now, x, reached, u)], axis=-1)
        h = self.with_memory(h, x)
        if medium := moving(h, self.seen):
            after = self.advance(medium.still, medium.through(x), u, t)
            return self.logged(h, x, medium.over(after, self.data.dt))
        dt, rates, limits = self.data.dt, h.rates, h.limits
        if not rates and not limits:
            return self.moved(h, x, u)
        needs_own = any(e.family.needs_own for e, _ in rates)
        own = self.named((self.moved(h, x, u) - x) / dt) if needs_own else {}
        start = x + 0.5 * dt * self.added_rate(rates, x, u, t, own)
        after, mean = self.limited(h, start, u, t)
        if needs_own:  # mean over this step: second order, and stable for a stiff model
            own = self.named(mean)
        last = self.added_rate(rates, after, u, t + dt, own)
        soft, dry = ([r for r in rates if r[0].family.dry == one] for one in (False, True))
        if soft:
            there = after + 0.5 * dt * last
            last = self.added_rate(soft, there, u, t + dt, own)
            if dry:
                last += self.added_rate(dry, after, u, t + dt, own)
        result = after + 0.5 * dt * last
        for i, j in self.tied:  # a carried heading rate is the heading's rate, effects included
            found = []
            for s, when in ((x, t), (result, t + dt)):
                rate = self.instant(h, s, u)
                own = self.named(rate) if needs_own or limits else {}
                added = self.added_rate([*rates, *limits], s, u, when, own)
                found.append(rate[..., i] + added[..., i])
            result[..., j] = x[..., j] + found[1] - found[0]
        return self.logged(h, x, result)

    def with_memory(self, h: Hypothesis, x: Array) -> Hypothesis:
        """Return a hypothesis with the memories of its joints along a track x (L, B, n)."""
        own = joint_memory.remembering(h)
        if not own or own[0][2][0] in own[0][1]:
            return h
        values = tuple((name, *v.items()) for name, v in zip(h.names, h.values, strict=True))
        key = (values, self.params(h).tobytes(), x.tobytes())
        z = self._remembered.made(key, lambda: joint_memory.along(self, h, x))
        return joint_memory.at(h, z)

    def widened(self, h: Hypothesis, x: Array) -> Array:
        """Return a track x (L, B, n) with the memories of joints behind its states."""
        own = joint_memory.remembering(self.with_memory(h, x))
        z = [values[name][..., None] for _, values, names in own for name in names]  # type: ignore
        return np.concatenate([x, *z], axis=-1) if z else x

    def logged(self, h: Hypothesis, x: Array, after: Array) -> Array:
        """Return states after a step from x (or slopes of them) with delayed logs updated."""
        model = self.data.model
        return (
            after
            if behind_logs(model) is None
            else logged(model, x, after, self.params(h), self.data.dt)
        )

    def marched(self, h: Hypothesis, x: Array, u: Array) -> Array | None:
        """Roll the model out from x (M, n) with received u (T, M, m or 2 m): states (T + 1, M, n).

        None if the hypothesis adds to the model's steps, if the model is not compiled, or if inputs
        change more than once within a step.
        """
        (T, M, width), model = u.shape, self.data.model
        march = getattr(model.system, "march", None)
        if march is None or adds_to_steps(h):
            return None
        if width == model.m:
            return np.asarray(march(x, u, self.params(h), self.data.dt))
        parts = delayed(h.acting, self.data) if self.divisible else None
        if parts is None or behind_logs(model) is not None:
            return None
        split = self._split(u, parts)
        sent = np.stack([now for now, _ in split], axis=1).reshape(-1, M, model.m)
        lengths = np.tile([length for _, length in split], T)
        return np.asarray(march(x, sent, self.params(h), lengths)[:: len(split)])

    def moved(self, h: Hypothesis, x: Array, u: Array, dt: float | None = None) -> Array:
        """Return the model's step with the joints' losses, without added or limited rates."""
        if medium := moving(h, self.seen):
            x = medium.through(x)
            return medium.over(self.moved(medium.still, x, u, dt), dt or self.data.dt)
        left, more = self.left(h, x, u, dt)
        if dt is None and left[..., self.data.model.m :].any():
            after = self._within(h, x, left)
        else:
            after = self.step(x, left, self.params(h), dt)
        for q in more:
            after[..., self.seen.index(q)] += more[q]
        return after

    def _within(self, h: Hypothesis, x: Array, u: Array) -> Array:
        """Return the model's step from x (..., n) with inputs that change within it.

        Delays alone change an input once, a part of a step after it began, from the value that was
        sent one step before; so the step is made in parts. Of lags, and where it is not divisible,
        only the first moment is used: by how much u (..., 2 m) arrives early, the leads l. With F
        the step's slope and B l what these, held over a step, would add to its states, they add

            (F - 1) (1 - (F - 1) / 2) B l

        to third order in dt: dt B l of a position, -dt / tau B l of a servo's angle. The second
        factor is left out where the step is not divisible.
        """
        p, m = self.params(h), self.data.model.m
        parts = delayed(h.acting, self.data) if self.divisible else None
        if parts is None:
            mean, lead = u[..., :m], u[..., m:]
            after = self.step(x, mean, p)
            by = self.step(x, mean + lead, p) - after
            by = self.step(x + by, mean, p) - after - by
            less = self.step(x + by, mean, p) - after if self.divisible else by  # F by
            return np.asarray(after + by + 0.5 * (by - less))
        if parts.ndim == p.ndim == 1:
            return self.logged(h, x, self._in_parts(x, u, p, parts))
        found = np.empty_like(x)
        k, rows = p.shape[-1], len(x)
        each = np.hstack([np.broadcast_to(one, (rows, one.shape[-1])) for one in (p, parts)])
        for own, row in equal_rows(each):
            found[own] = self._in_parts(x[own], u[own], row[:k], row[k:])
        return self.logged(h, x, found)

    def _in_parts(self, x: Array, u: Array, p: Array, parts: Array) -> Array:
        """Step with inputs u (..., 2 m) that change once within it, after `parts` of it (m,)."""
        for now, length in self._split(u, parts):
            x = self.step(x, now, p, length)
        return x

    def _split(self, u: Array, parts: Array) -> list[tuple[Array, float]]:
        """Return the inputs (..., m) of each part of such a step, and how long it takes [s]."""
        m, within, found = self.data.model.m, parts * (1 - parts), list[tuple[Array, float]]()
        change = u[..., m:] * np.divide(2, within, out=np.zeros(m), where=within > 0)
        now, at = u[..., :m] - parts * change, 0.0  # the change is what it was before, less now
        for end in (*sorted({part for part in parts.tolist() if part > 0}), 1.0):
            found.append((now + change * (parts >= end), (end - at) * self.data.dt))
            at = end
        return found

    def left(self, h: Hypothesis, x: Array, u: Array, dt: float | None = None) -> Left:
        """Return inputs u (..., m) less the losses at x (..., n), and position terms (`ahead`)."""
        names = self.data.model.input_names
        if not (pairs := self.with_memory(h, x).losses):
            return u, {}
        found, at, dt = u.copy(), self.loads(h, x, u, dt), dt or self.data.dt
        taken = solved(pairs, at, dt)
        for (effect, _), loss in zip(pairs, taken, strict=True):
            found[..., names.index(coupled(effect.site)[0])] -= loss
        return found, ahead(pairs, at, taken, dt, self.positions)

    def loads(self, h: Hypothesis, x: Array, u: Array, dt: float | None = None) -> Loads:
        """Return what losses are solved from: speeds before, after without loss, gains, inputs."""
        names, p = self.data.model.input_names, self.params(h)
        drives = tuple(effect.site.targets for effect, _ in h.losses)
        rows = blake2b(x.tobytes() + u.tobytes() + p.tobytes()).digest()

        def step(a: Named) -> Named:
            return self.named(self.step(x, np.stack([a[n] for n in names], axis=-1), p, dt))

        def make() -> Loads:
            a = Named("input", names, [u[..., j] for j in range(len(names))])
            weights = self.weights(h, p, x.shape[:-1])
            slopes = self.taken.about(self.flat(x, u)[0]) if dt is None and self._taken else None
            if slopes is None:
                return loads(h.losses, self.named(x), a, step, weights)
            # cached slopes by the inputs are accurate enough
            by_u = slopes[1].reshape(*x.shape, len(names))
            driving = {coupled(effect.site)[0] for effect, _ in h.losses}
            answers = {tau: self.named(by_u[..., names.index(tau)]) for tau in driving}
            return loads_from(h.losses, self.named(x), a, step(a), answers, weights)

        # the values of the losses may differ: this does not depend on them
        return self._loads.made((drives, dt, rows), make, x.size)

    def weights(self, h: Hypothesis, p: Array, shape: tuple[int, ...]) -> list[Mapping[str, Any]]:
        """Return the weights of the velocities in each loss' speed, see `effects.drive`.

        Args:
            h: the hypothesis with the losses.
            p: parameters (k,), or of as many rows (M, k).
            shape: of those rows; then the weights have it too.
        """
        found = list[Mapping[str, Any]]()
        each, which = np.unique(np.atleast_2d(p), axis=0, return_inverse=True)
        for effect, _ in h.losses:
            rows = [self._weights_at(effect, row) for row in each]
            own: Mapping[str, Any] = rows[0]
            if len(own) > 1 and len(rows) > 1:
                times = math.prod(shape) // len(np.atleast_2d(p))
                at = np.repeat(which.reshape(-1), times).reshape(shape)
                own = {name: np.array([row[name] for row in rows])[at] for name in own}
            found.append(own)
        return found

    def _weights_at(self, effect: Effect, p: Array) -> Mapping[str, float]:
        kept = self._weights.setdefault(effect.site.joined, Cache(1000))
        given = dict(zip(self.data.model.param_names, p.tolist(), strict=True))
        return kept.made(
            p.tobytes(), lambda: weights_at(effect.site.model, effect.site.joined, given), 1
        )

    def _weight_slopes(self, h: Hypothesis, p: Array) -> list[dict[str, Array]]:
        """Return how the weights of each loss' speed change with the parameters, (k,) each."""
        found = list[dict[str, Array]]()
        for effect, _ in h.losses:
            base = self._weights_at(effect, p)
            slopes = {name: np.zeros(len(p)) for name in base}
            for i, scale in enumerate(self.data.model.spreads if len(base) > 1 else ()):
                if scale:
                    more = self._weights_at(effect, p + 1e-4 * scale * (np.arange(len(p)) == i))
                    for name in base:
                        slopes[name][i] = (more[name] - base[name]) / (1e-4 * scale)
            found.append(slopes)
        return found

    def loss_slopes(
        self, h: Hypothesis, x: Array, u: Array, f_x: Array, f_p: Array | None = None
    ) -> tuple[Array, Array]:
        """Return slopes of the losses: by state (..., m, n) and by parameter (..., m, k).

        f_x, f_p: slopes of the model's own step (..., n, n), (..., n, k).
        """
        names, pairs = self.data.model.input_names, self.with_memory(h, x).losses
        f_p, m = f_x[..., :0] if f_p is None else f_p, len(names)
        by_x, by_p = (np.zeros((*x.shape[:-1], m, f.shape[-1])) for f in (f_x, f_p))
        if not pairs:
            return by_x, by_p
        driving, at = [coupled(effect.site)[0] for effect, _ in pairs], self.loads(h, x, u)
        base, p = solved(pairs, at, self.data.dt), self.params(h)
        tilts = self._weight_slopes(h, p) if by_p.size else [{} for _ in pairs]
        free = self.step(x, u[..., :m], p) if any(len(one) > 1 for one in tilts) else x
        for i, weights in enumerate(self.weights(h, p, x.shape[:-1])):
            size = 1e-6 * self.data.scales.peak(next(iter(weights)))
            more = [value + size if j == i else value for j, value in enumerate(at.w)]
            ends = [value + size if j == i else value for j, value in enumerate(at.free)]
            started = solved(pairs, at._replace(w=more), self.data.dt)
            ended = solved(pairs, at._replace(free=ends), self.data.dt)
            for tau, was, by_w, by_end in zip(driving, base, started, ended, strict=True):
                row, slope = names.index(tau), (by_end - was)[..., None] / size
                for name, weight in weights.items():
                    k, by_k = self.seen.index(name), np.asarray(weight)[..., None]
                    by_x[..., row, :] += slope * by_k * f_x[..., k, :]
                    by_x[..., row, k] += weight * (by_w - was) / size
                    by_p[..., row, :] += slope * by_k * f_p[..., k, :]
                    if len(tilts[i]) > 1:
                        before = (by_w - was)[..., None] / size * x[..., k, None]
                        by_p[..., row, :] += (before + slope * free[..., k, None]) * tilts[i][name]
        return by_x, by_p

    def limited(self, h: Hypothesis, x: Array, u: Array, t: Array) -> tuple[Array, Array]:
        """Return the model's step under the effects that limit its rates, and its mean rate."""
        after, limits = self.moved(h, x, u), h.limits
        free = (after - x) / self.data.dt
        if not limits:
            return after, free
        parts = max(e.family.parts for e, _ in limits)
        dt, mean = self.data.dt / parts, np.zeros_like(x)
        touched = np.zeros((*x.shape[:-1], 1), bool)
        for k in range(parts):
            own = (self.moved(h, x, u, dt) - x) / dt
            added = self.added_rate(limits, x, u, t + k * dt, self.named(own))
            x, mean = x + dt * (own + added), mean + own / parts
            touched |= (added != 0).any(axis=-1, keepdims=True)
        return np.where(touched, x, after), np.where(touched, mean, free)

    @cached_property
    def positions(self) -> dict[str, tuple[str, float]]:
        """The positions among the states, see `places.integrated`."""
        return integrated(moved_model(self.data.model))

    @cached_property
    def seen(self) -> tuple[str, ...]:
        """State names as effects see them: a delayed log's current true value has its name."""
        return seen_names(self.data.model)

    def named(self, x: Array) -> Named:
        """Return states, or their rates (..., n), by name."""
        return Named("state", self.seen, [x[..., i] for i in range(len(self.seen))])

    def instant(self, h: Hypothesis, x: Array, u: Array) -> Array:
        """Return the model's own rates at x (..., n), from a very short step."""
        short = 1e-3 * self.data.dt
        return np.asarray((self.moved(h, x, u, short) - x) / short)

    @cached_property
    def tied(self) -> list[tuple[int, int]]:
        """Pairs (heading, heading rate) of rates that are only carried along."""
        names, model = self.seen, moved_model(self.data.model)
        found = [(names.index(n), k) for n in model.state_names if (k := partner(model, n))]
        return [(i, names.index(k)) for i, k in found]

    def added_rate(self, rates: Any, x: Array, u: Array, t: Array, own: Any) -> Array:
        """Return the total rate that (effect, values) pairs add at x (..., n), (..., n) [1/s]."""
        names, total = self.seen, np.zeros_like(x)
        for name, value in self.each_added(rates, x, u, t, own):
            total[..., names.index(name)] += value
        return total

    def each_added(self, rates: Any, x: Array, u: Array, t: Array, own: Any) -> Iterator[Any]:
        """Yield the state and the rate [1/s] of each part of `added_rate`.

        `own` are the model's own rates by name, for families that need them. If the model already
        has a moving medium, the rates act on velocities through it, at the nominal values.
        """
        s = self.named(x)
        if medium := medium_of(self.data.model):
            s = through_it(medium, s, quantities_of(medium, self._nominal))
        inputs = self.data.model.input_names
        a = Named("input", inputs, [u[..., j] for j in range(len(inputs))])
        for effect, values in rates:
            added = effect.family.rate(s, a, own, t, values, effect.site)
            yield from braked(effect, s, added, 0.5 * self.data.dt).items()

    @cached_property
    def _nominal(self) -> dict[str, float]:
        return {name: float(param.value) for name, param in self.data.model.params.items()}

    def offset(self, h: Hypothesis, track: Array) -> Array | float:
        """Return the log minus the state along a track (L + 1, B, n), 0.0 if sensors are exact."""
        names, dt, old = self.data.model.state_names, self.data.dt, track
        for i, tau in self.data.filters.items():
            old = old.copy()
            old[..., i] += filter_lag(old[..., i], tau / dt)
        for effect, values in h.pairs:
            if isinstance(effect.family, SensorDelayFamily | SensorLagFamily):
                old = old.copy()
                for i in map(names.index, effect.site.targets):
                    old[..., i] += sensor_offset(effect, values, old[..., i], dt)
        standing = self.standing(h, old)
        return standing if old is track else standing + old - track

    def standing(self, h: Hypothesis, shown: Array) -> Array | float:
        """Return what bias and scale of sensors add to the values they see (..., n), or 0.0."""
        sensors = [(e, v) for e, v in h.pairs if isinstance(e.family, SensorFamily)]
        if not sensors:
            return 0.0
        names, total = self.data.model.state_names, np.zeros_like(shown)
        for effect, values in sensors:
            i = names.index(effect.site.target)
            total[..., i] += sensor_offset(effect, values, shown[..., i], self.data.dt)
        return total
