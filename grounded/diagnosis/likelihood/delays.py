"""A late sensor, delayed or filtered: which sample of the log shows which state.

    y_i(t) = x_i(t - d),   d = (k + p) dt
    y_i(s + k) = (1 - p) x_i(s) + p x_i(s - 1)

So under a hypothesis with a delay the log of its channel is moved by k steps, and the filter takes
care of p (`grounded.filter.augmented`). What a sensor filters, tau y' = x - y, is kept by as much
as it is old, with x a straight line from sample to sample:

    y_i(s) = (1 - m) x_i(s) + (m - c) x_i(s - 1) + c y_i(s - 1)
                                                    c = exp(-dt / tau),   m = (1 - c) tau / dt

Both act on the process noise too: taken for the present state less an offset, a late sample would
contradict every disturbance, and its delay would go to whatever slows the motion. The first k
samples of a trial show what was before it, which no model predicts. All hypotheses are judged by
the same data, so they count too (`before`): as samples of a state that drifted into the trial at
rest, or at the pace of its beginning, whichever is likelier.

Noise (its weights) and adjoints belong to samples: outside the filter they stay in the log's order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import NoiseModel
from grounded.effects import Effect, SensorDelayFamily, SensorFamily, SensorLagFamily
from grounded.effects.actuator import along_lag
from grounded.filter.augmented import Delayed
from grounded.filter.kalman import Adjoint
from grounded.frozen import Array

UNKNOWN = 1e6  # variances: how little is known of a state that was not measured at first
SETTLED = 3.0  # time constants after which a filtered sensor has forgotten where it began
UNLIKE = 1.0  # nats that a sample of what was before a trial costs at most more than others


@dataclass(frozen=True, eq=False)
class Delays:
    """The late channels of a hypothesis, D of them: which, k, p and tau / dt of each."""

    data: Data
    channel: tuple[int, ...]
    whole: tuple[int, ...]
    part: Array  # (D,)
    tau: Array  # (D,) 0: not filtered

    @property
    def weights(self) -> Array:
        """Of the state, of that a step before, of what was shown then, (D, 3)."""
        kept = np.exp(-1 / np.maximum(self.tau, 1e-9))
        mean, p = self.tau * (1 - kept), self.part
        return np.stack([(1 - p) * (1 - mean), p * (1 - mean) + mean - kept, kept], axis=-1)

    @property
    def oldest(self) -> int:
        """How many steps before a moment its sample may still show."""
        return int(max(self.whole + np.ceil(SETTLED * self.tau))) + 1

    def in_filter(self) -> Delayed:
        """For the filter, every run the same."""
        B = len(self.data.valid)
        return Delayed(np.tile(self.channel, (B, 1)), np.tile(self.weights, (B, 1, 1)))

    def moved(self, h: Hypothesis) -> Delays:
        """With the delays of another hypothesis but the samples of this one: p may leave 0 .. 1."""
        steps = np.array(list(_named(h, self.data).values()))
        return replace(self, part=steps[:, 0] - np.array(self.whole), tau=steps[:, 1])

    def shown(self, now: Array, track: Array) -> Array:
        """What sensors show of states `now` (L + 1, B, n) that followed those of the track."""
        found = now.copy()
        for i, tau, (a, b, c) in zip(self.channel, self.tau, self.weights, strict=True):
            own = track[..., i]
            before = np.concatenate([2 * own[:1] - own[1:2], own[:-1]])  # as if it came so
            found[..., i] = a * now[..., i] + b * before
            if c > 0:
                shown = own + filter_lag(own, tau, self.first)
                found[0, :, i] = shown[0]
                found[1:, :, i] += c * shown[:-1]
        return found

    def samples(self) -> tuple[Array, Array]:
        """The log and what is seen of it, moved to the states it shows, (L + 1, B, n) each."""
        data = self.data
        y, seen = data.y.copy(), data.seen.copy()
        for i, k in zip(self.channel, self.whole, strict=True):
            at, there = self._source(k)
            y[..., i] = data.filled[at, i]
            seen[..., i] = there * np.isfinite(data.states[at, i])
        return y, seen

    def aligned(self, values: Array, missing: float = 0.0) -> Array:
        """Values of each sample, (L + 1, B, n, ...) or (L, B, n, ...), moved to the states."""
        found, skip = values.copy(), len(self.data.state_at.T) - len(values)
        own, run = self.data.state_at.T[skip:], self._run()[skip:]
        for i, k in zip(self.channel, self.whole, strict=True):
            at, there = (a[skip:] for a in self._source(k))
            found[:, :, i] = self._carried(values[:, :, i], (own, run), (at, there), missing)
        return found

    def restored(self, adjoint: Adjoint) -> Adjoint:
        """An adjoint of the moved samples, back in the log's order."""
        found = {"u": adjoint.u.copy(), "D": adjoint.D.copy()}
        own, run = self.data.state_at.T[1:], self._run()[1:]
        for i, k in zip(self.channel, self.whole, strict=True):
            at, there = (a[1:] for a in self._source(k))
            for values in found.values():
                values[..., i] = self._carried(values[..., i], (at, there), (own, run), 0.0)
        return replace(adjoint, **found)

    def noise(self, noise: NoiseModel) -> NoiseModel:
        """The same noise with the weights of the moved samples."""
        if isinstance(noise.weight_v, float):
            return noise
        return replace(noise, weight_v=self.aligned(noise.weight_v, 1.0))

    def before(
        self, noise: NoiseModel, entry: Array | None, track: Array, white: Array, weight: Array
    ) -> float:
        """Log density of the samples that show what was before the trials; without log 2 pi [nats].

        At most UNLIKE nats a sample below what the others have: it may have moved in any way.

        Args:
            noise: of the hypothesis.
            entry: how noise enters (L, B, n, n); None: as it is.
            track: (L + 1, B, n).
            white: whitened innovations (L, B, n) of all other samples.
            weight: 1 / their standard deviation, (L, B, n or more).
        """
        L, B, n = white.shape
        seen, colour = self.samples()[1][1:], noise.structure.tau is not None
        power = noise.process(self.data.dt)[..., :n] + (np.exp(noise.log_c) if colour else 0.0)
        power, total = np.broadcast_to(power, (L, B, n)), 0.0
        for i, k in zip(self.channel, self.whole, strict=True):
            if (k := min(k, L)) == 0:
                continue
            through = np.eye(n)[i] if entry is None else entry[:k, :, i]
            drift = (through**2 * power[:k]).sum(axis=-1)
            pace = (track[k] - track[0])[:, i] / max(k, 1)
            log = np.log(np.where(seen[..., i] > 0, weight[..., i], 1.0)) - 0.5 * white[..., i] ** 2
            mean = float((log * seen[..., i]).sum()) / max(float(seen[..., i].sum()), 1.0)
            least = (mean - UNLIKE) * float(self.data.seen[1 : k + 1, self.first, i].sum())
            total += max(least, *(self._drifted(noise, i, drift, p * pace) for p in (0.0, 1.0)))
        return total

    def _drifted(self, noise: NoiseModel, i: int, drift: Array, pace: Array) -> float:
        """Log density of the first samples, the state going `pace` (B,) a step, spread by `drift`.

        A Kalman filter of one state; drift (k, B) are the variances of its steps.
        """
        data = self.data
        L, runs = len(data.time), self.first
        R = np.broadcast_to(noise.measurement(L), (L + 1, *data.seen.shape[1:]))[:, runs, i]
        y, seen, total = data.y[:, runs, i], data.seen[:, runs, i], 0.0
        x, P = y[0], R[0] * np.where(seen[0] > 0, 1.0, UNKNOWN)
        for t in range(1, len(drift) + 1):
            x, P = x + pace[runs], P + drift[t - 1, runs]
            S, missed = P + R[t], y[t] - x
            total -= 0.5 * float((seen[t] * (missed**2 / S + np.log(S))).sum())
            K = seen[t] * P / S
            x, P = x + K * missed, P - K * P
        return total

    @cached_property
    def first(self) -> Any:
        """Runs that no other run goes before, as indices."""
        ends = self.data.state_at[:, -1]
        return np.flatnonzero(~np.isin(self.data.state_at[:, 0], ends))

    @cached_property
    def kept(self) -> Any:
        """Which flat states a run holds, of bool."""
        found = np.zeros(len(self.data.states), bool)
        found[self.data.state_at] = True
        return found

    def _run(self) -> Any:
        """Which states of a run are its own, (L + 1, B) of bool."""
        valid = self.data.valid.T > 0
        return np.concatenate([np.ones_like(valid[:1]), valid])

    def _source(self, k: int) -> tuple[Any, Any]:
        """Where in the flat states the sample of every state is, whether there is one."""
        data = self.data
        last = (np.cumsum(np.asarray(data.lengths) + 1) - 1)[data.trial_of]
        at = data.state_at.T + k
        there = (at <= last) & self._run()
        at = np.minimum(at, last)
        return at, there & self.kept[at]

    def _carried(self, values: Array, source: Any, target: Any, missing: float) -> Array:
        """Values (L, B, ...) from one place in the flat states to another: (index, whether)."""
        flat = np.full((len(self.data.states), *values.shape[2:]), missing)
        flat[source[0][source[1]]] = values[source[1]]
        there = target[1].reshape(*target[1].shape, *[1] * (values.ndim - 2))
        return np.where(there, flat[target[0]], missing)


def delays_of(h: Hypothesis, data: Data) -> Delays | None:
    """The delays of a hypothesis' sensors; None where it has none."""
    named = _named(h, data)
    if not named:
        return None
    steps, tau = np.array(list(named.values())).T
    whole = np.floor(steps + 1e-9)
    part = np.maximum(steps - whole, 0.0)
    return Delays(data, tuple(named), tuple(int(k) for k in whole), part, tau)


def delayed(effects: Sequence[Effect]) -> set[str]:
    """The states whose sensors some effects delay."""
    late = [effect for effect in effects if isinstance(effect.family, SensorDelayFamily)]
    return {name for effect in late for name in effect.site.targets}


def _named(h: Hypothesis, data: Data) -> dict[int, list[float]]:
    """By late channel its delay and its time constant, in steps; the instruments' filters first."""
    found = {i: [0.0, tau / data.dt] for i, tau in data.filters.items()}
    for effect, values in h.pairs:
        if isinstance(effect.family, SensorDelayFamily | SensorLagFamily):
            late = isinstance(effect.family, SensorDelayFamily)
            for name in effect.site.targets:
                steps = found.setdefault(data.model.state_names.index(name), [0.0, 0.0])
                steps[0 if late else 1] += float(values["d" if late else "tau"]) / data.dt
    return found


def filter_lag(track: Array, tau: float, settled: Any = ()) -> Array:
    """How far a filtered sensor is off along a track (L + 1, B), tau in steps.

    A run that goes on moved before as it does in its first two time constants; in those that begin
    a trial, `settled`, the sensor has settled.
    """
    count = int(np.clip(np.ceil(2 * tau), 1, len(track) - 1))
    first = -(track[count] - track[0]) / count * tau
    first[list(settled)] = 0.0
    follows = -tau * np.diff(track, axis=0, append=track[-1:])
    return np.ascontiguousarray(along_lag(follows.T, first, {"tau": tau}, 1.0).T)


def sensor_offset(effect: Effect, values: Mapping[str, float], track: Array, dt: float) -> Array:
    """What a sensor effect adds to the log of its state along a track (L + 1, B)."""
    if isinstance(effect.family, SensorFamily):
        return np.asarray(effect.family.measure(track, values) - track)
    if isinstance(effect.family, SensorLagFamily):
        return filter_lag(track, values["tau"] / dt)
    steps = values["d"] / dt
    slope = np.vstack([track[1:2] - track[:1], np.diff(track, axis=0)])
    whole, part = int(np.floor(steps)), steps - np.floor(steps)
    first = track[:1] - slope[:1] * np.arange(whole + 1, 0, -1)[:, None]  # as if it came so
    line = np.concatenate([first, track])
    count = len(track)
    old = (1 - part) * line[1 : count + 1] + part * line[:count]
    return np.asarray(old - track)
