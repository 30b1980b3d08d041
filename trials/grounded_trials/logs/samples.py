"""One signal's samples made fit for interpolation, and its value at any time.

Sorted by stamp, repeated stamps and numbers that are not finite dropped (and counted), scaled,
unwrapped. Between two samples further apart than the signal's max age nothing is known.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.signals import Series, SignalSpec

GAP_INTERVALS, GAP_STEPS, GAP_S = 5.0, 3.0, 0.1  # a gap, without max_age_s: more than all these
JUMP_S = 1.0  # a clock that goes back by more was set, or a simulation was started again


@dataclass(frozen=True, eq=False)
class Samples:
    """A signal's usable samples: value y[i] at t[i], stamps strictly rising."""

    name: str
    spec: SignalSpec
    t: Ints  # (N,) [ns]
    y: Floats  # (N,) scaled and unwrapped
    not_finite: int
    repeated: int
    out_of_order: int
    unstamped: int  # stamp 0 among others that are not

    @cached_property
    def interval(self) -> float:
        """Median time between samples [s]; infinite for one sample."""
        return float(np.median(np.diff(self.t))) * 1e-9 if len(self.t) > 1 else np.inf

    def max_gap(self, dt: float) -> float:
        """How far apart two samples may be for what lies between to be believed [s]."""
        if self.spec.max_age_s is not None:
            return self.spec.max_age_s
        return max(GAP_INTERVALS * self.interval, GAP_STEPS * dt, GAP_S)

    def check_linear(self) -> None:
        """Refuses a single sample, between which and the next nothing can be interpolated."""
        if len(self.t) < 2:
            raise _unusable(
                self.name, self.spec, 'one sample can\'t be interpolated; set resample = "hold"'
            )

    def linear(self, at: Ints, dt: float, origin: int) -> Floats:
        """Values at times [ns], interpolated; half an interval beyond the ends is allowed.

        Raises:
            GroundedError: where a time lies in a gap, or outside the samples.
        """
        i = np.clip(np.searchsorted(self.t, at, "right"), 1, len(self.t) - 1)
        t0, t1 = self.t[i - 1], self.t[i]
        self._refuse_gaps(at, t0, t1, dt, origin)
        fraction = (at - t0) / (t1 - t0)
        return self.y[i - 1] + fraction * (self.y[i] - self.y[i - 1])

    def hold(self, at: Ints, dt: float, origin: int) -> Floats:
        """Values at times [ns], those of the last sample before.

        Raises:
            GroundedError: where there is none, or it is older than max_age_s.
        """
        i = np.searchsorted(self.t, at, "right") - 1
        if (i < 0).any():
            first = (self.t[0] - origin) * 1e-9
            raise GroundedError(
                f"'{self.name}' ({self.spec.path}) has no sample before {first:.3f} s; "
                "start the span later"
            )
        limit = np.inf if self.spec.max_age_s is None else self.spec.max_age_s
        age = (at - self.t[i]) * 1e-9
        if (age > limit).any():
            k = int(np.argmax(age > limit))
            self._refuse(self.t[i[k]], at[k], limit, origin)
        return self.y[i]

    def before(self, at: int) -> float:
        """The value in force at a time [ns]; NaN if there is none yet."""
        i = int(np.searchsorted(self.t, at, "right")) - 1
        return float(self.y[i]) if i >= 0 else float("nan")

    def _refuse_gaps(self, at: Ints, t0: Ints, t1: Ints, dt: float, origin: int) -> None:
        limit = self.max_gap(dt)
        wide = (t1 - t0) * 1e-9 > limit
        wide &= (at > t0) & (at < t1)
        if wide.any():
            k = int(np.argmax(wide))
            self._refuse(t0[k], t1[k], limit, origin)
        beyond = np.maximum(t0 - at, at - t1) * 1e-9 > self.slack(dt)
        if beyond.any():
            k = int(np.argmax(beyond))
            raise GroundedError(
                f"'{self.name}' ({self.spec.path}) is not known at {(at[k] - origin) * 1e-9:.3f} s:"
                f" its samples go from {(self.t[0] - origin) * 1e-9:.3f} s "
                f"to {(self.t[-1] - origin) * 1e-9:.3f} s"
            )

    def slack(self, dt: float) -> float:
        """How far beyond its first and last sample a value is still taken [s]."""
        return 0.5 * min(self.interval, dt)

    def _refuse(self, t0: int, t1: int, limit: float, origin: int) -> None:
        raise GroundedError(
            f"'{self.name}' ({self.spec.path}) has a gap of {(t1 - t0) * 1e-9:.3f} s from "
            f"{(t0 - origin) * 1e-9:.3f} s to {(t1 - origin) * 1e-9:.3f} s after the start, more "
            f"than {limit:.3f} s; end the span before it, or set max_age_s if it may be bridged"
        )


def tidy(name: str, series: Series, *, unwrap: bool) -> Samples:
    """The usable samples of a signal.

    Raises:
        GroundedError: if there are none, or their clock jumps back.
    """
    spec, t = series.spec, series.t
    finite = np.isfinite(series.values)
    stamped = t != 0 if (t != 0).any() else np.ones(len(t), dtype=np.bool_)
    if not (t != 0).any() and len(t) > 1:
        raise _unusable(name, spec, f"all its {spec.clock} stamps are 0; use another clock")
    good = finite & stamped
    if not good.any():
        raise _unusable(name, spec, f"none of its {len(t)} values is a finite number")
    t, y = t[good], spec.scale * series.values[good] + spec.offset
    back = np.diff(t)
    if len(back) and back.min() < -JUMP_S * 1e9:
        k = int(np.argmin(back))
        raise _unusable(
            name,
            spec,
            f"its {spec.clock} clock jumps back by {-back[k] * 1e-9:.3f} s after sample {k}; it "
            'was set, or a simulation began again: cut the log there, or use clock = "log"',
        )
    order = np.argsort(t, kind="stable")
    t, y = t[order], y[order]
    last_of_stamp = np.append(np.diff(t) != 0, True)
    t, y = t[last_of_stamp], y[last_of_stamp]
    if unwrap or spec.unwrap:
        y = np.unwrap(y)
    return Samples(
        name=name,
        spec=spec,
        t=t - round(spec.delay_s * 1e9),
        y=y,
        not_finite=int((~finite).sum()),
        repeated=int((~last_of_stamp).sum()),
        out_of_order=int((back < 0).sum()),
        unstamped=int((~stamped).sum()),
    )


def _unusable(name: str, spec: SignalSpec, why: str) -> GroundedError:
    return GroundedError(f"'{name}' ({spec.path}) can't be used: {why}")
