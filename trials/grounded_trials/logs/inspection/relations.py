"""What the samples of a log say of which number is what: rates, and what a model's inputs do.

`Signals` reads the samples once and puts them on a common grid; `follows` compares two of them.

`by_inputs` decides which number is which input by the steps of the model. A model skeleton has
neither correct masses nor gravity, so the size of its error is meaningless: the smaller of two
torques fits anywhere. What is compared is the part of each state's motion that remains after
removing everything that the states may explain (drag, springs, gravity) and after giving every
input its best gain, with the model's sign. An assignment is taken if it is clearly better than
every other one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, permutations, product

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import probe
from grounded_trials.formats.messages import Floats
from grounded_trials.logs.inspection.guess import Guess
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
    """Compare w with the derivative of q, both averaged over a few samples.

    Args:
        q: (N,) position.
        w: (N,) rate.
        step: sample time [s].
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
        self.found: dict[str, Samples] = {}
        self._missing: set[str] = set()

    def read(self, paths: Iterable[str]) -> None:
        """Read the samples of further paths."""
        more = [p for p in dict.fromkeys(paths) if p not in self.found and p not in self._missing]
        clocks = {p: self.log.clock(self.log.topic_of(p)) for p in more}
        specs = {p: SignalSpec(p, clock=clock) for p, clock in clocks.items()}  # type: ignore[arg-type]
        try:
            series = read_signals(self.log.files, specs, self.log.layout) if specs else {}
        except OverBudget:
            raise
        except GroundedError:
            series = _one_by_one(self.log, specs)
        for path, one in series.items():
            try:
                found = tidy(path, one, unwrap="@rpy" in path)
            except GroundedError:
                continue
            angle = path in self._angles
            self.found[path] = replace(found, y=unwound(found.y, least=0.9)) if angle else found
        self._missing |= {*more} - self.found.keys()

    def grid(self, paths: Sequence[str]) -> tuple[float, list[Floats]] | None:
        """Interpolate signals on a common grid.

        Returns:
            Its step [s] and one column per path; None if the signals don't overlap.
        """
        self.read(paths)
        if not all(path in self.found and len(self.found[path].t) > ROWS for path in paths):
            return None
        samples = [self.found[path] for path in paths]
        start, stop = max(s.t[0] for s in samples), min(s.t[-1] for s in samples)
        step = max(s.interval for s in samples)
        step = max(step, (stop - start) * 1e-9 / LONGEST)
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
        """Return the largest correlation of a command with what follows it.

        Args:
            sent: path of the command.
            moved: path of the signal that may follow it.
            latest: largest delay [s].

        Returns:
            -1 for a constant one; None if the signals don't overlap.
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
        found = []
        for a, b in permutations(paths, 2):
            like = self.follows(a, b)
            if (power := like.tenfold) is not None:
                found.append((like.correlation, a, b, 1 / power))
        pairs: dict[str, tuple[str, float]] = {}
        for _, a, b, times in sorted(found, reverse=True):
            if not {one for q, (w, _) in pairs.items() for one in (q, w)} & {a, b}:
                pairs[a] = (b, times)
        return pairs


def _one_by_one(log: LogReport, specs: Mapping[str, SignalSpec]) -> dict[str, Series]:
    found: dict[str, Series] = {}
    for path, spec in specs.items():
        try:
            found |= read_signals(log.files, {path: spec}, log.layout)
        except GroundedError:
            continue
    return found


WINDOW = 0.05  # [s] length of a step: in shorter ones noise dominates
PIECES, PIECE_STEPS = 8, 20  # pieces of the log, evaluated separately; steps of the shortest
BETTER = 0.2  # [nats] lead in the squared error of all states: 10 % of the error
PIECES_AGREE = 0.75  # share of the pieces that must agree

Paths = tuple[str, ...]


def by_inputs(model: Model, guesses: Mapping[str, Guess], signals: Signals) -> dict[str, Guess]:
    """Return the unsure inputs as the model's steps decide them, {} if they are not conclusive.

    Args:
        model: however crude.
        guesses: of all its states and inputs.
        signals: the samples of all candidates.
    """
    unsure = [n for n in model.input_names if guesses[n].others]
    known = [*model.state_names, *model.input_names]
    if not unsure or not all(guesses[name].path for name in known if name not in unsure):
        return {}
    units = {**model.states, **model.inputs}
    fixed = {guesses[name].path for name in known if name not in unsure}
    choices = [
        [p for p in (guesses[n].path, *guesses[n].others) if p in signals.found and p not in fixed]
        for n in unsure
    ]
    apart = (chosen for chosen in product(*choices) if len({*chosen}) == len(chosen))
    tried = list(islice(apart, COMBINATIONS + 1))
    left: dict[Paths, Array] = {}
    for chosen in tried[:COMBINATIONS]:
        paths = {n: guesses[n].path for n in known} | dict(zip(unsure, chosen, strict=True))
        gridded = signals.grid(list(paths.values()))
        if gridded is not None:
            own = signals.log.stated
            scales = [guesses[name].scale * own.factor(paths[name], units[name]) for name in known]
            left[chosen] = _left(model, gridded[0], np.column_stack(gridded[1]) * scales)

    # The best must lead in most pieces of the log.
    if len(left) < 2 or len(tried) > COMBINATIONS:
        return {}
    best = min(left, key=lambda one: float(left[one].sum()))
    gains = [left[one] - left[best] for one in left if one != best]
    if not all(g.mean() > BETTER and (g > 0).mean() >= PIECES_AGREE for g in gains):
        return {}
    gain = min(float(g.mean()) for g in gains)
    why = found("start.steps", share=float(1 - np.exp(-gain / 2)), nats=gain / 2)
    taken = {n: _moved_to(guesses[n], path) for n, path in zip(unsure, best, strict=True)}
    return {n: one.because(why, sure=True) for n, one in taken.items()}


def _moved_to(guess: Guess, path: str) -> Guess:
    """Return the guess moved to another of its candidates."""
    if path == guess.path:
        return guess
    rest = tuple(p for p in (guess.path, *guess.others) if p not in ("", path))
    return replace(guess, path=path, others=rest, field=None, reasons=())


def _left(model: Model, step: float, values: Floats) -> Array:
    """Return the log squared error per piece (P,), summed over the states."""
    k, n = max(1, round(WINDOW / step)), model.n
    x, sums = values[:, :n], np.cumsum(np.vstack([np.zeros(model.m), values[:, n:]]), axis=0)
    u, dt = ((sums[k:] - sums[:-k]) / k)[: len(x) - k], probe(model, k * step)
    with np.errstate(all="ignore"):
        none = model.system.step(x[:-k], 0 * u, model.values, dt)
        moved = model.difference(x[k:], none)
        each = [
            model.difference(model.system.step(x[:-k], u * one, model.values, dt), none)
            for one in np.eye(model.m)
        ]
    good = np.isfinite(np.column_stack([moved, *each])).all(axis=1)
    moved, does = moved[good], np.stack(each)[:, good]
    own = _explained(model, x[:-k][good])
    pieces = np.array_split(np.arange(len(moved)), max(1, min(PIECES, len(moved) // PIECE_STEPS)))
    left = np.zeros(len(pieces))
    for i in range(n):
        both = np.column_stack([moved[:, i], *does[:, :, i]])
        both = both - own @ np.linalg.lstsq(own, both, rcond=None)[0]
        y, effects = both[:, 0], both[:, 1:]
        after = y - effects @ _gains(effects, y)
        left += [np.log(float(after[at] @ after[at]) + 1e-24) for at in pieces]
    return left


def _explained(model: Model, x: Array) -> Array:
    """Return regressors (N, k) for motion without inputs: the states, and sines of angles."""
    turns = [i for i, unit in enumerate(model.states.values()) if unit == "rad"]
    columns = [np.ones(len(x)), x, np.sin(x[:, turns]), np.cos(x[:, turns])]
    own = np.column_stack(columns)
    size: Array = own / np.maximum(np.abs(own).max(axis=0, initial=0.0), 1e-12)
    return size


def _gains(effects: Array, y: Array) -> Array:
    """Return the best gains, none below 0, since exchanged wheels would need negative ones."""
    from scipy.optimize import nnls

    size = np.sqrt((effects**2).sum(axis=0))
    used = size > 1e-9 * max(float(np.sqrt(y @ y)), 1e-12)
    gains = np.zeros(len(size))
    if used.any():
        gains[used] = nnls(effects[:, used] / size[used], y)[0] / size[used]
    return gains
