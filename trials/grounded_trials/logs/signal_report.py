"""Statistics of a log's signals, and warnings and errors that follow from them.

`SignalReport` states rate, jitter, gaps and dropped samples of one signal. `check_clocks` refuses
signals on different clocks, `staircase` warns of sensors that are late because rows repeat their
values, `warnings_of` turns reports into sentences.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from grounded.errors import GroundedError
from grounded.result import listed
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.samples import MIXED_S, Samples
from grounded_trials.logs.signals import Series

SKEW_S = 0.1  # signals whose clocks differ by more than this cause a warning
BRIDGED = 1.9  # a value between samples more than this many intervals apart counts as bridged
LEAST_RUNS, REPEATED = 20, 0.8  # a held signal: fewest runs, and share with two or more samples
COARSE = 2.5  # least ratio of median to smallest change of a signal that is not quantised
FAR = 10.0  # times the range of all other samples of a signal: a sample is far outside them
LOST = 0.1  # least share of a log that is told if one state lacks it
DISORDERED = 0.01  # least share of stamps out of order that is told; sorting loses nothing of them


@dataclass(frozen=True)
class SignalReport:
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
    repeated: int  # dropped: same stamp as the next
    out_of_order: int
    unstamped: int  # dropped: stamp 0
    low: float  # smallest value in the trial, scaled
    high: float  # largest value in the trial, scaled


def report_of(
    samples: Samples, series: Series, values: Floats, at: Ints, origin: int
) -> SignalReport:
    """Return the report on a signal that has `values` at the times `at` [ns]."""
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
        skew_s=series.skew_s,
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


def check_clocks(series: Mapping[str, Series]) -> None:
    """Raise an error for signals on different clocks, such as simulation time and log time.

    Raises:
        GroundedError: naming two of them, and the difference.
    """
    first, last, apart = _furthest({name: s.skew_s for name, s in series.items()})
    if apart > MIXED_S:
        a, b = series[first].spec.clock, series[last].spec.clock
        raise GroundedError(
            f"'{first}' (clock {a}) and '{last}' (clock {b}) are on clocks that differ by "
            f"{apart:.3f} s (simulation time, or an unset clock?); use the same clock for both, "
            'such as clock = "log"'
        )


def _furthest(skews: Mapping[str, float | None]) -> tuple[str, str, float]:
    """Return the signals whose clocks are furthest behind and ahead, and the difference [s].

    A skew of None stands for the log's own clock.
    """
    known = {name: skew or 0.0 for name, skew in skews.items()}
    first, last = min(known, key=known.__getitem__), max(known, key=known.__getitem__)
    return first, last, known[last] - known[first]


def staircases(series: Sequence[Samples], first: int, last: int, dt: float) -> list[str]:
    """Return warnings on signals that are late because rows repeat each of their values.

    A table has a row per sample of its fastest signal, so rows repeat the samples of a slower
    sensor. A quantised signal also repeats values, but changes by few different steps.

    Args:
        series: of states.
        first: the trial's start [ns].
        last: the trial's end [ns].
        dt: control step [s]; values held for up to half of it don't matter.

    Returns:
        One warning for all signals that change at the same rate.
    """
    slow: dict[str, list[str]] = {}
    for samples in series:
        t, y = samples.within(first, last)
        new = np.flatnonzero(np.append(True, np.diff(y) != 0)) if len(y) else np.empty(0, int)
        lengths, sizes = np.diff(new), np.abs(np.diff(y[new]))
        if len(lengths) < LEAST_RUNS or np.mean(lengths >= 2) < REPEATED:
            continue
        apart = float(t[new[-1]] - t[new[0]]) * 1e-9 / len(lengths)
        if apart <= dt / 2 or float(np.median(sizes)) < COARSE * float(sizes.min()):
            continue
        late = (apart - samples.interval) / 2
        rates = f"{1 / apart:.3g} Hz, but rows come at {1 / samples.interval:.3g} Hz"
        slow.setdefault(f"{rates}: samples are held and {late:.2g} s late", []).append(samples.name)
    advice = "Leave cells empty in rows that repeat a value (or log the sensor's own messages)"
    found = []
    for text, names in slow.items():
        which, s = listed(map(repr, names)), "s" * (len(names) == 1)
        found.append(
            f"{which} change{s} at {text} on average. {advice}: then they are interpolated"
        )
    return found


def outliers(series: Sequence[Samples], first: int, last: int) -> list[str]:
    """Return warnings on single samples far outside everything else that their signal has.

    Args:
        series: of states.
        first: the trial's start [ns].
        last: the trial's end [ns].
    """
    found = []
    for samples in series:
        t, y = samples.within(first, last)
        if len(y) < LEAST_RUNS:
            continue
        jump = np.abs(np.diff(y))  # in and out again, or a step would count
        alone = np.minimum(jump[:-1], jump[1:])
        i = int(np.argmax(alone)) + 1
        others = np.delete(y, i)
        if alone[i - 1] > FAR * np.ptp(others) > 0:
            found.append(
                f"'{samples.name}' is {y[i]:.4g} at {(t[i] - first) * 1e-9:.3f} s, far outside all "
                f"its other samples, {others.min():.4g} to {others.max():.4g}: delete that row or "
                "message from the log"
            )
    return found


def vanished(series: Sequence[Samples], last: int) -> list[str]:
    """Return a warning on a signal that ends the trial, long before the others end.

    Args:
        series: of states.
        last: the trial's end [ns].
    """
    ends = {samples.name: int(samples.t[-1]) for samples in series}
    origin = min((int(samples.t[0]) for samples in series), default=0)
    gone = [name for name, end in ends.items() if end <= last]
    goes_on = max(ends.values(), default=0)
    if not gone or last - origin > (1 - LOST) * (goes_on - origin):
        return []
    until, whole = ((end - origin) * 1e-9 for end in (ends[gone[0]], goes_on))
    return [
        f"{listed(map(repr, gone))} has no sample after {until:.2f} s of the log, in which other "
        f"states go on until {whole:.2f} s: the trial ends there"
    ]


def warnings_of(reports: tuple[SignalReport, ...], late: float) -> tuple[str, ...]:
    """Return warnings on a trial, as sentences for a person."""
    found = []
    if late > 0:
        found.append(f"the trial starts {late:.3f} s late, when all states are known")
    alike: dict[str, list[str]] = {}  # what holds of the signals of one message is said once
    for r in reports:
        for text in _warnings_of(r):
            alike.setdefault(text, []).append(f"'{r.name}'")
    found += [f"{listed(names)}: {text}" for text, names in alike.items()]
    low, high, apart = _furthest({r.name: r.skew_s for r in reports})
    if len({r.clock for r in reports}) > 1 and apart > SKEW_S:
        found.append(f"'{low}' and '{high}' are on clocks that differ by {apart:.3f} s")
    return tuple(found)


def _warnings_of(r: SignalReport) -> Iterator[str]:
    """Yield warnings on one signal, without its name."""
    if r.not_finite:
        yield f"{r.not_finite} of {r.samples} values are not finite numbers"
    if r.bridged:
        gap = f"{r.largest_gap_s:.3f} s at {r.largest_gap_at_s:.3f} s"
        yield f"{r.bridged} values bridged, the largest gap is {gap}"
    disordered = r.out_of_order if r.out_of_order >= DISORDERED * r.samples else 0
    kinds = ("out of order", disordered), ("repeated", r.repeated), ("0", r.unstamped)
    if counts := [f"{n} stamp{'s' * (n > 1)} {kind}" for kind, n in kinds if n]:
        yield ", ".join(counts)
    if r.samples == 1:
        yield "held from a single sample"
