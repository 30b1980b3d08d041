"""What the samples of a log say of which number is what: rates, commands of angles.

`Signals` reads the samples once and puts them on a common grid; `follows` compares two of them.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from grounded.errors import GroundedError
from grounded_trials.formats.messages import Floats
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.samples import Samples, tidy, unwound
from grounded_trials.logs.signals import Series, SignalSpec, read_signals
from grounded_trials.within import OverBudget

FOLLOWS, SURELY = 0.8, 0.95  # correlation of a rate with a derivative: named so, or not
SAME = 0.15  # relative tolerance of the size of a rate
COMBINATIONS, LONGEST = 64, 20_000  # largest number of combinations tried; samples of a grid
ROWS = 20  # fewest samples that are compared
SPAN = 5  # samples over which a slope is taken


@dataclass(frozen=True)
class Follows:
    """Correlation of two signals, and how many times as large the second is."""

    correlation: float
    slope: float

    @property
    def tenfold(self) -> float | None:
        """The power of ten by which it is surely larger than the derivative, None otherwise."""
        power = 10.0 ** round(np.log10(max(self.slope, 1e-9)))
        surely = self.correlation > SURELY and abs(self.slope / power - 1) < SAME
        return power if surely else None

    @property
    def points(self) -> float:
        """What it says for the two being a position and its rate: the share it explains [nats]."""
        return float(-np.log(max(1 - self.correlation**2, 1e-12)))


def follows(q: Floats, w: Floats, step: float) -> Follows:
    """Compare w (N,) with the derivative of q (N,), both averaged over a few samples.

    `step` is the sample time [s].
    """
    slope = (q[SPAN:] - q[:-SPAN]) / (SPAN * step)
    mean = np.convolve(0.5 * (w[1:] + w[:-1]), np.ones(SPAN) / SPAN, "valid")
    good = np.isfinite(slope) & np.isfinite(mean)
    a, b = slope[good], mean[good]
    if len(a) < ROWS or a.std() < 1e-9 or b.std() < 1e-9:
        return Follows(0.0, 1.0)
    a, b = a - a.mean(), b - b.mean()
    return Follows(float(a @ b / np.sqrt((a @ a) * (b @ b))), float(a @ b / (a @ a)))


class Signals:
    """The samples of a log's numbers, read once, and put on a common grid on request.

    Args:
        log: an inspected log.
        angles: paths of numbers that may wrap, in radians or degrees.
    """

    def __init__(self, log: LogReport, angles: Collection[str] = ()) -> None:
        self.log, self._angles = log, angles
        self.found: dict[str, Samples | None] = {}  # None: they can't be read

    def read(self, paths: Iterable[str]) -> None:
        """Read the samples of further paths."""
        clocks = {p: self.log.clock(self.log.topic_of(p)) for p in paths if p not in self.found}
        specs = {p: SignalSpec(p, clock=clock) for p, clock in clocks.items()}
        series: dict[str, Series] = {}
        try:
            series = read_signals(self.log.files, specs, self.log.layout) if specs else {}
        except OverBudget:
            raise
        except GroundedError:  # for one of them, which has a text in some messages
            for path, spec in specs.items():
                with suppress(GroundedError):
                    series |= read_signals(self.log.files, {path: spec}, self.log.layout)
        self.found |= dict.fromkeys(specs)
        for path, one in series.items():
            with suppress(GroundedError):
                found = tidy(path, one, unwrap="@rpy" in path)
                angle = path in self._angles
                self.found[path] = replace(found, y=unwound(found.y, least=0.9)) if angle else found

    def grid(self, paths: Sequence[str]) -> tuple[float, list[Floats]] | None:
        """Interpolate signals on a common grid.

        Returns:
            Its step [s] and one column per path; None if the signals don't overlap.
        """
        self.read(paths)
        samples = [s for path in paths if (s := self.found[path]) and len(s.t) > ROWS]
        if len(samples) < len(paths):
            return None
        start, stop = max(s.t[0] for s in samples), min(s.t[-1] for s in samples)
        step = max(*(s.interval for s in samples), (stop - start) * 1e-9 / LONGEST)
        t = np.arange(start, stop, round(step * 1e9), dtype=np.int64)
        if len(t) < ROWS:
            return None
        at = (t - start) * 1e-9
        return step, [np.interp(at, (s.t - start) * 1e-9, s.y) for s in samples]

    def follows(self, a: str, b: str) -> Follows:
        """Return how b follows the derivative of a, as logged; a correlation of 0 if unknown."""
        gridded = self.grid((a, b)) if a != b else None
        if gridded is None:
            return Follows(0.0, 1.0)
        step, (q, w) = gridded
        return follows(q, w, step)

    def lagged(self, sent: str, moved: str, latest: float) -> float | None:
        """Return the largest correlation of a command with what follows it, -1 for a constant one.

        None if the signals don't overlap.
        """
        gridded = self.grid((sent, moved))
        if gridded is None:
            return None
        step, (u, y) = gridded
        with np.errstate(invalid="ignore", divide="ignore"):
            delays = range(1 + min(round(latest / step), len(u) // 2))
            likes = [np.corrcoef(u[: len(u) - late], y[late:])[0, 1] for late in delays]
        return float(np.nanmax([-1.0, *likes]))

    def rates(self, paths: Sequence[str]) -> dict[str, tuple[str, float]]:
        """Return which numbers are the rate of which: {position: (rate, factor of the rate)}.

        Only pairs whose units differ by a power of ten; each number is in one pair at most.
        """
        self.read(paths)
        likes = ((self.follows(a, b), a, b) for a, b in permutations(paths, 2))
        found = [(like.correlation, a, b, 1 / by) for like, a, b in likes if (by := like.tenfold)]
        pairs: dict[str, tuple[str, float]] = {}
        for _, a, b, times in sorted(found, reverse=True):
            if not {one for q, (w, _) in pairs.items() for one in (q, w)} & {a, b}:
                pairs[a] = (b, times)
        return pairs
