"""Statistics of a log's signals, and findings that follow from them.

`SignalReport` states rate, jitter, gaps and dropped samples of one signal. `check_clocks` refuses
signals on different clocks, `findings_of` says what is odd in reports. Values that are held or far
outside are found in trials: `grounded.accounts.signals`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, Quantity, Weight, found
from grounded.result import Document
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.samples import MIXED_S, Samples
from grounded_trials.logs.signals import Series

SKEW_S = 0.1  # signals whose clocks differ by more than this cause a warning
BRIDGED = 1.9  # a value between samples more than this many intervals apart counts as bridged
LOST = 0.1  # least share of a log that is told if one state lacks it


@dataclass(frozen=True, eq=False)
class SignalReport(Document):
    """Statistics of one signal; durations in seconds, positions in seconds after the start."""

    name: str
    path: str
    type: str
    clock: str
    samples: int  # in the whole log
    rate_hz: float  # 1 / median interval; 0 for one sample
    jitter_s: float  # half the width that holds 90 % of the intervals
    largest_gap_s: float  # between samples, within the trial
    largest_gap_at_s: float
    bridged: int  # values of the trial that were interpolated over a gap
    skew_s: float | None  # median of stamp minus log time; None: it is on the log's clock
    not_finite: int  # dropped: NaN or infinite
    stamps: int  # same as the next, 0, or out of order; see `Samples`
    low: float  # smallest value in the trial, scaled
    high: float  # largest value in the trial, scaled


def report_of(
    samples: Samples, series: Series, values: Floats, at: Ints, origin: int
) -> SignalReport:
    """Return the report on a signal that has `values` at the times `at` [ns]."""
    t, gaps, bridged = samples.t, np.diff(samples.t) * 1e-9, 0
    inside = np.where((t[1:] > at[0]) & (t[:-1] < at[-1]), gaps, 0.0)
    i = int(np.argmax(inside)) if inside.any() else None
    low, high = np.percentile(gaps, [5, 95]) if len(gaps) else (0.0, 0.0)
    if len(t) > 1:
        before, after = (t[some] for some in samples.around(at))
        wide = (after - before) * 1e-9 > BRIDGED * samples.interval
        bridged = int((wide & (at > before) & (at < after)).sum())
    return SignalReport(
        name=samples.name,
        path=samples.spec.path,
        type=series.type,
        clock=samples.spec.clock,
        samples=len(series.t),
        rate_hz=1 / samples.interval if len(t) > 1 else 0.0,
        jitter_s=float(high - low) / 2,
        largest_gap_s=0.0 if i is None else float(gaps[i]),
        largest_gap_at_s=0.0 if i is None else float((t[i] - origin) * 1e-9),
        bridged=bridged,
        skew_s=series.skew_s,
        not_finite=samples.not_finite,
        stamps=samples.stamps,
        low=float(values.min()),
        high=float(values.max()),
    )


def check_clocks(series: Mapping[str, Series]) -> list[Finding]:
    """Return what there is to say of signals whose clocks differ a little.

    Refuse those on different clocks, such as simulation time and log time.
    """
    behind = {name: one.skew_s or 0.0 for name, one in series.items()}  # None: the log's own
    first, last = min(behind, key=behind.__getitem__), max(behind, key=behind.__getitem__)
    apart = behind[last] - behind[first]
    if apart > MIXED_S:
        raise GroundedError(found("file.clocks", first, last, apart=apart))
    told = apart > SKEW_S and len({one.spec.clock for one in series.values()}) > 1
    return [found("file.clocks", first, last, apart=apart, weight=Weight.WARN)] * told


def vanished(series: Sequence[Samples], last: int) -> list[Finding]:
    """Find a signal that ends the trial, long before the others end."""
    ends = {samples.name: int(samples.t[-1]) for samples in series}
    origin = min((int(samples.t[0]) for samples in series), default=0)
    gone = [name for name, end in ends.items() if end <= last]
    goes_on = max(ends.values(), default=0)
    if not gone or last - origin > (1 - LOST) * (goes_on - origin):
        return []
    until, whole = ((end - origin) * 1e-9 for end in (ends[gone[0]], goes_on))
    return [found("file.vanished", *gone, until=until, whole=whole)]


def findings_of(reports: tuple[SignalReport, ...], late: float) -> list[Finding]:
    """Return what is odd in the signals of a trial; what several share is told once."""
    odd = [found("file.vanished", late=late)] if late > 0 else []
    alike: dict[tuple[Any, ...], list[str]] = {}
    for r in reports:
        facts = r.not_finite, r.bridged, int(r.samples == 1), r.stamps
        if any(facts):
            alike.setdefault((*facts, Quantity(r.largest_gap_s, "s"), r.samples), []).append(r.name)
    keys = ("lost", "bridged", "single", "stamps", "gap", "samples")
    rows = ((dict(zip(keys, facts, strict=True)), names) for facts, names in alike.items())
    return odd + [found("file.odd_values", *names, **facts) for facts, names in rows]
