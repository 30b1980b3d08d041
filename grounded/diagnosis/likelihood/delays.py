"""Delayed and filtered sensors: which sample of the log shows which state.

A delay is k whole steps and a fraction p of a step:

    y_i(t) = x_i(t - d),   d = (k + p) dt
    y_i(s + k) = (1 - p) x_i(s) + p x_i(s - 1)

Under a hypothesis with a delay, the log of the channel is shifted by k steps, and the filter
handles p by an augmented state (`grounded.filter.augmented`). A sensor with a first-order filter,
tau y' = x - y, and x linear between samples obeys

    y_i(s) = (1 - m) x_i(s) + (m - c) x_i(s - 1) + c y_i(s - 1)
                                                    c = exp(-dt / tau),   m = (1 - c) tau / dt

Treating a late sample as the present state plus a computed offset would be wrong: process noise is
seen late, too. Every disturbance would contradict the sample, and the delay would be attributed to
anything that slows the motion.

The first k samples of a trial show states from before it, which no model predicts. They are
included all the same (`before`), because all hypotheses must be compared on the same data: as
samples of a random walk that enters the trial at rest, or at its initial rate, whichever is
likelier.

Noise weights and adjoints belong to samples: outside the filter they stay in the order of the log.
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

UNKNOWN = 1e6  # initial variance of an unmeasured state, in measurement variances
SETTLED = 3.0  # time constants after which a filtered sensor has forgotten its initial value
UNLIKE = 1.0  # most nats by which a sample from before a trial may be less likely than the others


@dataclass(frozen=True, eq=False)
class Delays:
    """The D late channels of a hypothesis, with k, p and tau / dt of each."""

    data: Data
    channel: tuple[int, ...]
    whole: tuple[int, ...]
    part: Array  # (D,)
    tau: Array  # (D,) in steps; 0: not filtered

    @property
    def weights(self) -> Array:
        """Weights of x(s), x(s - 1) and y(s - 1) in the sample y(s), (D, 3)."""
        kept = np.exp(-1 / np.maximum(self.tau, 1e-9))
        mean, p = self.tau * (1 - kept), self.part
        return np.stack([(1 - p) * (1 - mean), p * (1 - mean) + mean - kept, kept], axis=-1)

    @property
    def oldest(self) -> int:
        """Age in steps of the oldest state that a sample may show."""
        return int(max(self.whole + np.ceil(SETTLED * self.tau))) + 1

    def in_filter(self) -> Delayed:
        """Return the late channels for the filter, the same for every run."""
        B = len(self.data.valid)
        return Delayed(np.tile(self.channel, (B, 1)), np.tile(self.weights, (B, 1, 1)))

    def moved(self, h: Hypothesis) -> Delays:
        """Take the delays of h but keep the shift by k steps, so that p may leave 0 .. 1."""
        steps = np.array(list(_named(h, self.data).values()))
        return replace(self, part=steps[:, 0] - np.array(self.whole), tau=steps[:, 1])

    def shown(self, now: Array, track: Array) -> Array:
        """Return what sensors show of states `now` (L + 1, B, n), each a step after the track's."""
        found = now.copy()
        for i, tau, (a, b, c) in zip(self.channel, self.tau, self.weights, strict=True):
            own = track[..., i]
            before = np.concatenate([2 * own[:1] - own[1:2], own[:-1]])  # extrapolated backwards
            found[..., i] = a * now[..., i] + b * before
            if c > 0:
                shown = own + filter_lag(own, tau, self.first)
                found[0, :, i] = shown[0]
                found[1:, :, i] += c * shown[:-1]
        return found

    def samples(self) -> tuple[Array, Array]:
        """Return the log and its mask, shifted to the states it shows, (L + 1, B, n) each."""
        data = self.data
        y, seen = data.y.copy(), data.seen.copy()
        for i, k in zip(self.channel, self.whole, strict=True):
            at, there = self._source(k)
            y[..., i] = data.filled[at, i]
            seen[..., i] = there * np.isfinite(data.states[at, i])
        return y, seen

    def aligned(self, values: Array, missing: float = 0.0) -> Array:
        """Shift values per sample, (L + 1, B, n, ...) or (L, B, n, ...), to the states shown."""
        found, skip = values.copy(), len(self.data.state_at.T) - len(values)
        own, run = self.data.state_at.T[skip:], self._run()[skip:]
        for i, k in zip(self.channel, self.whole, strict=True):
            at, there = (a[skip:] for a in self._source(k))
            found[:, :, i] = self._carried(values[:, :, i], (own, run), (at, there), missing)
        return found

    def restored(self, adjoint: Adjoint) -> Adjoint:
        """Return an adjoint of the shifted samples in the order of the log."""
        found = {"u": adjoint.u.copy(), "D": adjoint.D.copy()}
        own, run = self.data.state_at.T[1:], self._run()[1:]
        for i, k in zip(self.channel, self.whole, strict=True):
            at, there = (a[1:] for a in self._source(k))
            for values in found.values():
                values[..., i] = self._carried(values[..., i], (at, there), (own, run), 0.0)
        return replace(adjoint, **found)

    def noise(self, noise: NoiseModel) -> NoiseModel:
        """Return the same noise with its weights shifted as the samples are."""
        if isinstance(noise.weight_v, float):
            return noise
        return replace(noise, weight_v=self.aligned(noise.weight_v, 1.0))

    def before(
        self, noise: NoiseModel, entry: Array | None, track: Array, white: Array, weight: Array
    ) -> float:
        """Return the log density of samples that show states from before the trials [nats].

        Without the terms log 2 pi. It is bounded below by UNLIKE nats per sample less than the mean
        of the other samples, because the state may have moved in any way.

        Args:
            noise: the noise of the hypothesis.
            entry: how noise enters (L, B, n, n); None: the identity.
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
        """Return the log density of the first samples under a random walk with a mean rate.

        A scalar Kalman filter: the state moves by `pace` (B,) per step, with variance drift (k, B).
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
        """Indices of the runs that do not continue another run."""
        ends = self.data.state_at[:, -1]
        return np.flatnonzero(~np.isin(self.data.state_at[:, 0], ends))

    @cached_property
    def kept(self) -> Any:
        """Flat states that are in a run, of bool."""
        found = np.zeros(len(self.data.states), bool)
        found[self.data.state_at] = True
        return found

    def _run(self) -> Any:
        """Return which states of a run are not padding, (L + 1, B) of bool."""
        valid = self.data.valid.T > 0
        return np.concatenate([np.ones_like(valid[:1]), valid])

    def _source(self, k: int) -> tuple[Any, Any]:
        """Return the flat index of the sample that shows each state, and whether it exists."""
        data = self.data
        last = (np.cumsum(np.asarray(data.lengths) + 1) - 1)[data.trial_of]
        at = data.state_at.T + k
        there = (at <= last) & self._run()
        at = np.minimum(at, last)
        return at, there & self.kept[at]

    def _carried(self, values: Array, source: Any, target: Any, missing: float) -> Array:
        """Move values (L, B, ...) between places in the flat states, each (index, mask)."""
        flat = np.full((len(self.data.states), *values.shape[2:]), missing)
        flat[source[0][source[1]]] = values[source[1]]
        there = target[1].reshape(*target[1].shape, *[1] * (values.ndim - 2))
        return np.where(there, flat[target[0]], missing)


def delays_of(h: Hypothesis, data: Data) -> Delays | None:
    """Return the delays of a hypothesis' sensors, or None."""
    named = _named(h, data)
    if not named:
        return None
    steps, tau = np.array(list(named.values())).T
    whole = np.floor(steps + 1e-9)
    part = np.maximum(steps - whole, 0.0)
    return Delays(data, tuple(named), tuple(int(k) for k in whole), part, tau)


def delayed(effects: Sequence[Effect]) -> set[str]:
    """Return the names of the states whose sensors are delayed by some effect."""
    late = [effect for effect in effects if isinstance(effect.family, SensorDelayFamily)]
    return {name for effect in late for name in effect.site.targets}


def _named(h: Hypothesis, data: Data) -> dict[int, list[float]]:
    """Return {channel: [delay, time constant]} in steps, including filters from the accounts."""
    found = {i: [0.0, tau / data.dt] for i, tau in data.filters.items()}
    for effect, values in h.pairs:
        if isinstance(effect.family, SensorDelayFamily | SensorLagFamily):
            late = isinstance(effect.family, SensorDelayFamily)
            for name in effect.site.targets:
                steps = found.setdefault(data.model.state_names.index(name), [0.0, 0.0])
                steps[0 if late else 1] += float(values["d" if late else "tau"]) / data.dt
    return found


def filter_lag(track: Array, tau: float, settled: Any = ()) -> Array:
    """Return a filtered sensor's output minus its input along a track (L + 1, B), tau in steps.

    A run that continues a trial is assumed to have moved before at the mean rate of its first two
    time constants. In the `settled` runs, which begin a trial, the sensor starts in steady state.
    """
    count = int(np.clip(np.ceil(2 * tau), 1, len(track) - 1))
    first = -(track[count] - track[0]) / count * tau
    first[list(settled)] = 0.0
    follows = -tau * np.diff(track, axis=0, append=track[-1:])
    return np.ascontiguousarray(along_lag(follows.T, first, {"tau": tau}, 1.0).T)


def sensor_offset(effect: Effect, values: Mapping[str, float], track: Array, dt: float) -> Array:
    """Return what a sensor effect adds to the log of its state along a track (L + 1, B)."""
    if isinstance(effect.family, SensorFamily):
        return np.asarray(effect.family.measure(track, values) - track)
    if isinstance(effect.family, SensorLagFamily):
        return filter_lag(track, values["tau"] / dt)
    steps = values["d"] / dt
    slope = np.vstack([track[1:2] - track[:1], np.diff(track, axis=0)])
    whole, part = int(np.floor(steps)), steps - np.floor(steps)
    first = track[:1] - slope[:1] * np.arange(whole + 1, 0, -1)[:, None]  # extrapolated backwards
    line = np.concatenate([first, track])
    count = len(track)
    old = (1 - part) * line[1 : count + 1] + part * line[:count]
    return np.asarray(old - track)
