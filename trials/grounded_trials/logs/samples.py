"""One signal of a log: clean samples, and values at any time.

`tidy` sorts by stamp, drops (and counts) repeated stamps and numbers that are not finite, scales
and unwraps. `Samples` interpolates or holds; between samples further apart than the signal's
max_age_s the value is unknown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from grounded.checks import refused
from grounded.errors import GroundedError
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.signals import Series, SignalSpec

GAP_INTERVALS, GAP_STEPS, GAP_S = 5.0, 3.0, 0.1  # without max_age_s a gap exceeds all of these
BEFORE_S, FEWEST = 1.0, 8  # [s] before a time from which samples tell the value there; how many
QUANTUM = 2e-3  # of a signal's range: the least noise of its samples
STRAIGHT = 1.5  # largest scatter about a line, by a sample's noise
SURE = 3.0  # standard deviations from which a motion, or another value, is no noise
NEAR_0_S = 10.0  # if other stamps come nearer to 0 than this, a stamp of 0 is valid
MIXED_S = 1.0  # clocks that differ or jump back by more than this are refused
SPARSE = 50.0  # steps between two samples above which the log's time seems to be in another unit
MOSTLY, WHOLE = (0.01, 0.99), 1.02  # the values of a wrapped angle are so nearly within a turn
DISORDERED = 0.01  # least share of stamps out of order that counts: sorting mends them
REGULAR = 10  # an input with more samples is sent continuously; it ends the trial with its last

How = Literal["linear", "hold", "mean"]  # what gives the value between samples


@dataclass(frozen=True)
class Lead:
    """What the samples before a time say of the value there."""

    line: float  # by a straight line through them
    exact: bool  # the line is as good as the sample there, without the `QUANTUM`
    mean: float
    moves: bool  # the line is not level, by more than noise
    off: bool  # the mean is not 0, by more than noise


@dataclass(frozen=True, eq=False)
class Samples:
    """A signal's usable samples: value y[i] at t[i], stamps strictly increasing."""

    name: str
    spec: SignalSpec
    t: Ints  # (N,) [ns]
    y: Floats  # (N,) scaled and unwrapped
    not_finite: int
    stamps: int  # those repeated, or 0 although others are not; out of order if many are
    lost: Ints  # (K,) [ns] stamps of samples that are not finite numbers

    @cached_property
    def interval(self) -> float:
        """Median time between samples [s]; infinite for one sample."""
        return float(np.median(np.diff(self.t))) * 1e-9 if len(self.t) > 1 else np.inf

    @property
    def first_stamp(self) -> int:
        """Stamp of the first sample [ns], before a sensor's delay_s is subtracted."""
        sensor = 0 < self.spec.delay_s <= MIXED_S  # other values of delay_s bridge two clocks
        return int(self.t[0]) + round(self.spec.delay_s * 1e9) * sensor

    def around(self, at: Ints) -> tuple[Ints, Ints]:
        """Return the indices (M,) of the samples before and after times [ns]; at an end, of two."""
        after = np.clip(np.searchsorted(self.t, at, "right"), 1, len(self.t) - 1)
        return after - 1, after

    def max_gap(self, dt: float) -> float:
        """Return the largest distance of two samples between which values are known [s]."""
        if self.spec.max_age_s is not None:
            return self.spec.max_age_s
        return max(GAP_INTERVALS * self.interval, GAP_STEPS * dt, GAP_S)

    def check_linear(self, dt: float) -> None:
        """Raise an error if interpolation is impossible: one sample, or far too few for steps."""
        if len(self.t) < 2:
            raise _unusable(self.name, self.spec, "one")
        if self.interval > SPARSE * dt and self.spec.max_age_s is None:
            facts = {"path": self.spec.path, "every": self.interval, "dt": dt}
            raise refused("file.gap", self.name, **facts)

    def sampled(self, how: How, at: Ints, dt: float, origin: int) -> Floats:
        """Return values (M,) at times [ns] of a grid of steps dt [s].

        Linear: interpolated, up to half an interval beyond the ends. Hold: of the last sample
        before each time (zero-order hold). Mean: of the held value over the step about each time.

        Raises:
            GroundedError: if a time is in a gap, or outside the samples, which are told in seconds
                after `origin` [ns]; if a held sample is older than max_age_s, or older than the
                largest gap and newer ones were not finite.
        """
        by = {"linear": self._linear, "hold": self._hold, "mean": self._mean}
        return by[how](at, dt, origin)

    def _linear(self, at: Ints, dt: float, origin: int) -> Floats:
        i, j = self.around(at)
        t0, t1 = self.t[i], self.t[j]
        limit = self.max_gap(dt)
        wide = ((t1 - t0) * 1e-9 > limit) & (at > t0) & (at < t1)
        if wide.any():
            k = int(np.argmax(wide))
            raise self._gap(t0[k], t1[k], limit, origin)
        beyond = np.maximum(t0 - at, at - t1) * 1e-9 > self.slack(dt)
        if beyond.any():
            raise self._outside(origin, int(at[np.argmax(beyond)]))
        return self.y[i] + (at - t0) / (t1 - t0) * (self.y[j] - self.y[i])

    def _hold(self, at: Ints, dt: float, origin: int) -> Floats:
        i = np.searchsorted(self.t, at, "right") - 1
        if (i < 0).any():
            raise self._outside(origin)
        limit = np.inf if self.spec.max_age_s is None else self.spec.max_age_s
        lost = np.searchsorted(self.lost, at, "right") > np.searchsorted(self.lost, self.t[i])
        limits = np.where(lost, min(limit, self.max_gap(dt)), limit)
        old = (at - self.t[i]) * 1e-9 > limits
        if old.any():
            k = int(np.argmax(old))
            raise self._gap(self.t[i[k]], at[k], limits[k], origin)
        return self.y[i]

    def _mean(self, at: Ints, dt: float, origin: int) -> Floats:
        held, half = self._hold(at, dt, origin), round(dt * 0.5e9)
        since = (self.t - self.t[0]) * 1e-9
        total = np.concatenate([[0.0], np.cumsum(self.y[:-1] * np.diff(since))])
        edges = []
        for edge in (at - half, at + half):
            i = np.maximum(np.searchsorted(self.t, edge, "right") - 1, 0)
            edges.append(total[i] + self.y[i] * ((edge - self.t[0]) * 1e-9 - since[i]))
        changes = np.concatenate([[0], np.cumsum(np.diff(self.y) != 0)])
        seen = np.searchsorted(self.t, [at - half, at + half - 1], "right") - 1
        begun, ended = changes[np.maximum(seen, 0)]
        return np.where(begun == ended, held, (edges[1] - edges[0]) / (2e-9 * half))

    def leading_to(self, at: int) -> Lead | None:
        """Return what the samples of the second before a time [ns] say of the value there.

        None if that is no better than the sample there: with few samples, or if these scatter more
        about a straight line than from one to the next, as those of a robot that moves do.
        """
        before = (self.t <= at) & (self.t > at - round(BEFORE_S * 1e9))
        t, y = 1e-9 * (self.t[before] - at), self.y[before]
        if len(y) < FEWEST:
            return None
        tilt, level = np.polyfit(t, y, 1)
        own = float(np.sqrt((np.diff(y) ** 2).mean() / 2))
        noise = own + QUANTUM * float(np.ptp(self.y))
        scatter = float(np.sqrt(((y - level - tilt * t) ** 2).sum() / (len(y) - 2)))
        there = self.y[min(int(np.searchsorted(self.t, at)), len(self.t) - 1)]
        off_line = max(scatter / STRAIGHT, float(abs(there - level)) / SURE)
        if off_line > noise:
            return None
        moves, mean = abs(tilt) * t.std() * len(y) ** 0.5 > SURE * noise, float(y.mean())
        off = abs(mean) > SURE * noise / len(y) ** 0.5
        return Lead(float(level), off_line <= own, mean, bool(moves), off)

    def held_from(self, at: int, value: float) -> Samples:
        """Return the samples with a value added at an earlier time [ns], if it is earlier."""
        if at >= self.t[0]:
            return self
        return replace(self, t=np.r_[at, self.t], y=np.r_[value, self.y])

    def before(self, at: int) -> float:
        """Return the value in force at a time [ns]; NaN before the first sample."""
        i = int(np.searchsorted(self.t, at, "right")) - 1
        return float(self.y[i]) if i >= 0 else float("nan")

    def slack(self, dt: float) -> float:
        """Return how far beyond the first and last sample a value is extrapolated [s]."""
        return 0.5 * min(self.interval, dt)

    def _outside(self, origin: int, at: int | None = None) -> GroundedError:
        first, last = (f"{(self.t[i] - origin) * 1e-9:.3f}" for i in (0, -1))
        when = first if at is None else f"{(at - origin) * 1e-9:.3f}"
        facts = {"path": self.spec.path, "at": when, "first": first, "last": last}
        return refused("file.gap", self.name, **facts)

    def _gap(self, t0: int, t1: int, limit: float, origin: int) -> GroundedError:
        start, end = (f"{(t - origin) * 1e-9:.3f}" for t in (t0, t1))
        facts = {"path": self.spec.path, "start": start, "end": end, "limit": limit}
        return refused("file.gap", self.name, **facts)


def at_rest(leads: Mapping[str, Lead | None], rates: Sequence[str]) -> bool:
    """Return whether samples before a time show that no state moves, and no velocity is off 0."""
    return bool(leads) and all(
        one and not (one.moves or (one.off and n in rates)) for n, one in leads.items()
    )


def tidy(name: str, series: Series, *, unwrap: bool) -> Samples:
    """Return the usable samples of a signal: sorted, finite, scaled, unwrapped.

    They are kept with the raw samples, since a run is sought at many instants of a log. The name is
    for messages; `unwrap`: as an angle even if its spec does not say so. Refused are signals
    without samples, or with a clock that jumps back.
    """
    if (name, unwrap) not in series.tidied:
        series.tidied[name, unwrap] = _tidied(name, series, unwrap)
    tidied: Samples = series.tidied[name, unwrap]
    return tidied


def _tidied(name: str, series: Series, unwrap: bool) -> Samples:
    spec, t = series.spec, series.t
    finite = np.isfinite(series.values)
    if not (t != 0).any() and len(t) > 1:
        raise _unusable(name, spec, "zero")
    nearest = np.abs(t[t != 0]).min(initial=2**62)
    apart = np.abs(np.diff(t[t != 0]))
    usual = float(np.median(apart)) if len(apart) else 0.0
    near = max(NEAR_0_S * 1e9, 2 * usual)  # simulation time runs through 0, a slow log from 0
    stamped = (t != 0) | (nearest < near)
    good = finite & stamped
    if not good.any():
        raise _unusable(name, spec, "nothing", len(t))
    t, y = t[good], spec.scale * series.values[good] + spec.offset
    back = np.diff(t)
    if len(back) and back.min() < -MIXED_S * 1e9:
        k = int(np.argmin(back))
        by = float(-back[k]) * 1e-9
        raise refused("file.clocks", name, by=by, sample=str(k))
    late, many = int((back < 0).sum()), DISORDERED * len(series.t)
    order = np.argsort(t, kind="stable")
    t, y = t[order], y[order]
    last_of_stamp = np.append(np.diff(t) != 0, True)
    t, y = t[last_of_stamp], y[last_of_stamp]
    if unwrap or spec.unwrap:
        y = unwound(y)
    return Samples(
        name=name,
        spec=spec,
        t=t - round(spec.delay_s * 1e9),
        y=y,
        not_finite=int((~finite).sum()),
        stamps=int((~last_of_stamp).sum()) + int((~stamped).sum()) + late * (late >= many),
        lost=np.sort(series.t[stamped & ~finite]) - round(spec.delay_s * 1e9),
    )


def unwound(y: Floats, *, least: float = 0.5) -> Floats:
    """Unwrap an angle (N,) by the turn that it stays within: of radians, else of degrees.

    One that goes further is continuous, and unwrapped as radians it would be folded. No step
    smaller than `least` of a turn is the end of one.
    """
    width = np.ptp(np.quantile(y, MOSTLY))
    turn = next((turn for turn in (2 * np.pi, 360.0) if width < WHOLE * turn), np.inf)
    return np.unwrap(y, period=turn) if np.abs(np.diff(y)).max(initial=0.0) > least * turn else y


def _unusable(name: str, spec: SignalSpec, what: str, values: int = 0) -> GroundedError:
    return refused("file.signal", name, path=spec.path, what=what, values=values)


def check_overlap(states: Sequence[Samples], inputs: Sequence[Samples]) -> None:
    """Refuse signals that end before others begin: their stamps are on two clocks.

    The end of a signal that is held, or sent rarely, is ignored: it stays in force after that. The
    error names the signals of both clocks, and the delay_s that aligns them.
    """
    held = [s for s in states if s.spec.resample == "hold"]
    held += [s for s in inputs if len(s.t) <= REGULAR or s.spec.max_age_s is not None]
    end = min((int(s.t[-1]) for s in (*states, *inputs) if s not in held), default=2**62)
    late = [s for s in (*states, *inputs) if (int(s.t[0]) - end) * 1e-9 > MIXED_S]
    if not late:
        return
    early = [s for s in (*states, *inputs) if s not in late]
    first, begin = (min(int(s.t[0]) for s in some) for some in (early, late))
    moved, by = (late, begin - first) if any(s in inputs for s in early) else (early, first - begin)
    lines = "; ".join(
        f"[log.{'state' if s in states else 'input'}.{s.name}] delay_s = "
        f"{s.spec.delay_s + by * 1e-9:.3f}"
        for s in moved
    )
    names = [s.name for s in (*early, *late)]
    raise refused("file.clocks", *names, apart=abs(by) * 1e-9, lines=lines)
