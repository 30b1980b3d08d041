"""What a log's signal looked like: how often, how regular, how late, what had to be bridged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.samples import Samples
from grounded_trials.logs.signals import Series

MIXED_S = 1.0  # signals on different clocks whose clocks differ by more don't fit each other
SKEW_S = 0.1  # and by more than this, they may be shifted
BRIDGED = 1.9  # a value between samples this many intervals apart was bridged


@dataclass(frozen=True)
class SignalReport:
    """One signal as it was found; times in seconds, places in seconds after the trial's start."""

    name: str
    path: str
    type: str
    clock: str
    samples: int  # in the whole log
    rate_hz: float  # 1 / median interval; 0 for one sample
    jitter_s: float  # half the width that holds 90 % of the intervals
    largest_gap_s: float  # between samples, within the trial
    largest_gap_at_s: float
    bridged: int  # values of the trial that lie in a gap
    skew_s: float | None  # median of stamp minus log time; None: it is on the log's clock
    not_finite: int  # dropped: NaN or infinite
    repeated: int  # dropped: same stamp as the next
    out_of_order: int
    unstamped: int  # dropped: stamp 0
    low: float  # smallest and largest value in the trial, scaled
    high: float


def report_of(
    samples: Samples, series: Series, values: Floats, at: Ints, origin: int
) -> SignalReport:
    """The report on a signal that was sampled at times `at` [ns], giving `values`."""
    t = samples.t
    gaps = np.diff(t) * 1e-9
    inside = (t[1:] > at[0]) & (t[:-1] < at[-1])
    widest, place = 0.0, 0.0
    if inside.any():
        i = int(np.flatnonzero(inside)[np.argmax(gaps[inside])])
        widest, place = float(gaps[i]), float((t[i] - origin) * 1e-9)
    low, high = np.percentile(gaps, [5, 95]) if len(gaps) else (0.0, 0.0)
    return SignalReport(
        name=samples.name,
        path=samples.spec.path,
        type=series.type,
        clock=samples.spec.clock,
        samples=len(series.t),
        rate_hz=1 / samples.interval if len(t) > 1 else 0.0,
        jitter_s=float(high - low) / 2,
        largest_gap_s=widest,
        largest_gap_at_s=place,
        bridged=_bridged(samples, at),
        skew_s=_skew(series),
        not_finite=samples.not_finite,
        repeated=samples.repeated,
        out_of_order=samples.out_of_order,
        unstamped=samples.unstamped,
        low=float(values.min()),
        high=float(values.max()),
    )


def _bridged(samples: Samples, at: Ints) -> int:
    t = samples.t
    if len(t) < 2:
        return 0
    i = np.clip(np.searchsorted(t, at, "right"), 1, len(t) - 1)
    wide = (t[i] - t[i - 1]) * 1e-9 > BRIDGED * samples.interval
    return int((wide & (at > t[i - 1]) & (at < t[i])).sum())


def _skew(series: Series) -> float | None:
    if series.spec.clock == "log":
        return None
    return float(np.median(series.t - series.log_times)) * 1e-9


def check_clocks(series: Mapping[str, Series]) -> None:
    """Refuses signals whose clocks differ: one by the header of a simulation, one by the log.

    Raises:
        GroundedError: naming two of them, and the difference.
    """
    skews = {name: _skew(s) or 0.0 for name, s in series.items()}
    if not skews:
        return
    first, last = min(skews, key=skews.__getitem__), max(skews, key=skews.__getitem__)
    if skews[last] - skews[first] > MIXED_S:
        a, b = series[first].spec.clock, series[last].spec.clock
        raise GroundedError(
            f"'{first}' (clock {a}) and '{last}' (clock {b}) are on clocks that differ by "
            f"{skews[last] - skews[first]:.3f} s (simulation time, or an unset clock?); read both "
            'by the same one, such as clock = "log"'
        )


def warnings_of(reports: tuple[SignalReport, ...], late: float) -> tuple[str, ...]:
    """Sentences about what a person should know before believing the trial."""
    found = []
    if late > 0:
        found.append(f"the trial starts {late:.3f} s late, when every state is known")
    for r in reports:
        if r.not_finite:
            found.append(f"'{r.name}': {r.not_finite} of {r.samples} values are not finite numbers")
        if r.bridged:
            found.append(
                f"'{r.name}': {r.bridged} values bridged, the largest gap is "
                f"{r.largest_gap_s:.3f} s at {r.largest_gap_at_s:.3f} s"
            )
        if r.out_of_order or r.repeated or r.unstamped:
            found.append(
                f"'{r.name}': {r.out_of_order} stamps out of order, {r.repeated} repeated, "
                f"{r.unstamped} zero"
            )
        if r.samples == 1:
            found.append(f"'{r.name}': held from a single sample")
    skews = {r.name: r.skew_s or 0.0 for r in reports}
    low, high = min(skews, key=skews.__getitem__), max(skews, key=skews.__getitem__)
    if len({r.clock for r in reports}) > 1 and skews[high] - skews[low] > SKEW_S:
        found.append(
            f"'{low}' and '{high}' are on clocks that differ by {skews[high] - skews[low]:.3f} s"
        )
    return tuple(found)
