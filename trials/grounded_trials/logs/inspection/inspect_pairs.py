"""Find positions and rates among a log's numbers: which one follows the derivative of which.

`paired` tries which candidates are a state and its rate where the model has q' = w. If a candidate
found by name does not follow, the unassigned numbers are tried. `Signals` reads the samples.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, permutations, product
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.model import Model
from grounded.places import integrals
from grounded_trials.formats.messages import Floats
from grounded_trials.logs.inspection.inspect_guess import SIMULATED_S, Guess
from grounded_trials.logs.inspection.inspect_log import LogReport
from grounded_trials.logs.samples import Samples, tidy
from grounded_trials.logs.signals import Series, SignalSpec, read_signals
from grounded_trials.logs.stated_units import LENGTHS, Stated, factor_between, may_be
from grounded_trials.within import OverBudget

SLOPE = 0.01  # tolerance of the factor 1 in q' = w
FOLLOWS = 0.8  # correlation of a rate with the derivative of its position
SURELY = 0.95  # the same, without matching names
COMBINATIONS, LONGEST = 64, 20_000  # largest number of combinations tried; samples of a grid
FEW = 8  # largest number of unnamed signals tried as a position or a rate
MANY = 60  # largest number of signals tried in place of one that does not follow
SAME, DEGREE = 0.15, 180 / np.pi
SPAN = 5  # samples over which a slope is taken


def velocities(model: Model) -> dict[str, str]:
    """Return the states whose rate is another state of the model: {q: w}."""
    names = model.state_names
    own = [r for r in integrals(model) if r.exact and abs(r.c - 1) < SLOPE]
    return {names[r.i]: names[r.j] for r in own}


def paired(
    guesses: Mapping[str, Guess],
    pair: tuple[str, str],
    signals: Signals,
    units: Mapping[str, str],
    log: LogReport,
    joints: Mapping[str, str],
) -> dict[str, Guess]:
    """Check a position and its rate against each other; fill in one without a matching name.

    Args:
        guesses: of all states and inputs.
        pair: names of the position and its rate.
        signals: the samples of all candidates.
        units: of the model, by name.
        log: an inspected log.
        joints: units of joints' numbers by path.

    Returns:
        The changed guesses. Candidates without a matching name are unassigned numbers whose unit
        fits.
    """
    taken = {guess.path for guess in guesses.values()}
    free = [path for path in log.moving if path not in taken]
    own = {name: guesses[name] for name in pair}
    bare = [name for name, guess in own.items() if not guess.path and not guess.others]
    if not bare:
        found = _derivative(own[pair[0]], own[pair[1]], signals, units)
        return found if len(found) != 1 else _elsewhere(found, own, pair, free, signals, units)
    if not 0 < len(free) <= FEW or not any(guess.path for guess in guesses.values()):
        return {}
    fits = {name: tuple(p for p in free if may_be(p, units[name], joints)) for name in bare}
    tried = {name: replace(one, others=fits.get(name, one.others)) for name, one in own.items()}
    signals.read(free)
    found = _derivative(tried[pair[0]], tried[pair[1]], signals, units)
    if len(found) < 2:
        return {}
    known = len(bare) == 1 and all(own[name].sure for name in pair if name not in bare)
    why = "no name matches" + "; only this pair of the rest fits" * (len(bare) == 2)
    for name in bare:
        one = found[name]
        same = one.scale == 1 and (name == pair[0] or one.sure)
        found[name] = replace(one, sure=known and same, reasons=(why, *one.reasons))
    return found


def _elsewhere(
    found: Mapping[str, Guess],
    own: Mapping[str, Guess],
    pair: tuple[str, str],
    free: Sequence[str],
    signals: Signals,
    units: Mapping[str, str],
) -> dict[str, Guess]:
    """Look for a rate among unassigned numbers if the one found by name does not follow.

    A name may mislead: `w` may be a component of a quaternion.
    """
    q, w = (own[name] for name in pair)
    if not 0 < len(free) <= MANY:
        return dict(found)
    signals.read(free)
    again = _derivative(
        replace(q, others=()), replace(w, path="", others=tuple(free)), signals, units
    )
    if len(again) < 2:
        return dict(found)
    moved = again[w.name]
    others = tuple(dict.fromkeys((w.path, *w.others)))
    why = f"not {w.path}, despite its name"
    return {
        **again,
        w.name: replace(moved, sure=False, others=others, reasons=(why, *moved.reasons)),
    }


def _derivative(q: Guess, w: Guess, signals: Signals, units: Mapping[str, str]) -> dict[str, Guess]:
    """Return both guesses, after trying which pair of candidates are a position and its rate.

    The scales exclude the units that the log states, which `as_stated` multiplies in.
    """
    stated = signals.stated
    tried = []
    pairs = product([p for p in (q.path, *q.others) if p], [p for p in (w.path, *w.others) if p])
    for rank, (a, b) in enumerate(islice(pairs, COMBINATIONS)):
        gridded = signals.grid((a, b)) if a != b else None
        if gridded is not None:
            step, (position, rate) = gridded
            found = follows(position, rate, step)
            tried.append((abs(found.correlation) - 0.02 * rank, found, a, b))
    if not tried:
        return {}
    _, best, a, b = max(tried, key=lambda one: one[0])
    by = stated.factor(a, units[q.name]), stated.factor(b, units[w.name])
    logged, best = best, replace(best, slope=best.slope * by[1] / by[0])
    crossed = _crossed(signals, a, b, best)
    mirrored = best.correlation < -SURELY and abs(best.slope + 1) < SAME
    if crossed and not mirrored:
        found_q, found_w = (replace(moved_to(*one), sure=False) for one in ((q, a), (w, b)))
        return {q.name: found_q, w.name: replace(found_w, reasons=(*found_w.reasons, crossed))}
    if abs(best.correlation) < FOLLOWS:
        why = f"it does not follow the derivative of {q.path} (correlation {best.correlation:.2f})"
        return {w.name: replace(w, sure=False, reasons=(*w.reasons, why))}
    scale, what = scale_of(best.slope)
    why = f"follows the derivative of {a}, correlation {best.correlation:.3f}{what}"
    fits = abs(best.slope * scale - 1) < SAME
    found_q, found_w = moved_to(q, a), moved_to(w, b)
    if fits or scale != 1.0:
        if scale in (DEGREE, -DEGREE):  # the position is in degrees
            found_q = replace(found_q, scale=1 / DEGREE, sure=False)
            scale /= DEGREE
        found_w = replace(found_w, scale=scale, sure=found_w.sure or (fits and found_q.sure))
    elif abs(abs(logged.slope) - 1) < SAME and bool(stated.unit(a)) != bool(stated.unit(b)):
        why += ", of the same size as logged: both are assumed to have the same unit"
        if stated.unit(a):
            found_w = replace(found_w, scale=scale * by[0], sure=False)
        else:
            found_q = replace(found_q, scale=by[1], sure=False)
            found_w = replace(found_w, scale=scale, sure=False)
    elif not (q.path and w.path) and abs(best.correlation) < SURELY:
        return {}  # neither name nor size fits: a voltage follows the speed that it drives
    else:
        why += f", but {best.slope:.3g} times as large"
        found_w = replace(found_w, sure=False)
    if best.correlation < 0:  # either of the two may have the wrong sign, or be another signal
        found_w = replace(found_w, sure=False)
    reasons = (*found_w.reasons, f"{why}; or {crossed}" if crossed else why)
    return {q.name: found_q, w.name: replace(found_w, reasons=reasons)}


def _crossed(signals: Signals, a: str, b: str, as_named: Follows) -> str:
    """Return that a position and its rate look exchanged, or "".

    Where a load swings, its angular acceleration is opposite to the angle: with the columns
    exchanged the rate follows the derivative of the position, too, but with the opposite sign or
    another size. Only the right order has both right.

    Args:
        signals: with the samples of both.
        a: the path of the position.
        b: the path of its rate.
        as_named: the comparison of `b` with the derivative of `a`.
    """
    if as_named.correlation > FOLLOWS and abs(as_named.slope - 1) < SAME:
        return ""
    if (gridded := signals.grid((b, a))) is None:
        return ""
    step, (position, rate) = gridded
    back = follows(position, rate, step)
    if back.correlation < SURELY or abs(back.slope - 1) > SAME:
        return ""
    return (
        f"{a} and {b} look exchanged: {a} follows the derivative of {b}, correlation "
        f"{back.correlation:.3f}, with the right sign and size; if so, exchange these paths"
    )


def agreed(
    guesses: Mapping[str, Guess],
    pair: tuple[str, str],
    signals: Signals,
    units: Mapping[str, str],
    log: LogReport,
    joints: Mapping[str, str],
) -> dict[str, Guess]:
    """Mark a position and its rate as sure if all evidence of the log agrees, whatever the names.

    The position is the only number with a unit of its kind, the rate follows its derivative in that
    unit, and no other number fits either of them as well. The position of a sliding joint counts as
    in metres.
    """
    stated, (q, w) = signals.stated, (guesses[name] for name in pair)
    fields = log.moving
    if (q.sure and w.sure) or not (q.path and w.path) or len(fields) > MANY:
        return {}

    def of_its_kind(path: str) -> bool:
        slide = joints.get(path, "")
        said = stated.unit(path) or slide * (slide in LENGTHS)
        return bool(said) and factor_between(said, units[q.name]) is not None

    if [path for path in fields if of_its_kind(path)] != [q.path]:
        return {}
    signals.read(fields)

    def like(a: str, b: str) -> Follows | None:
        if (gridded := signals.grid((a, b))) is None:
            return None
        step, (position, rate) = gridded
        return follows(position, rate, step)

    own = like(q.path, w.path)
    if own is None or own.correlation < SURELY or abs(own.slope - 1) > SAME:
        return {}
    rest = [path for path in fields if path not in (q.path, w.path)]
    rivals = [like(q.path, path) for path in rest] + [like(path, w.path) for path in rest]
    if any(one is not None and abs(one.correlation) > FOLLOWS for one in rivals):
        return {}
    return {one.name: replace(one, sure=True, others=()) for one in (q, w)}


def rates_among(log: LogReport, paths: Sequence[str]) -> dict[str, tuple[str, float]]:
    """Return which numbers are the rate of which: {position: (rate, factor of the rate)}.

    Only pairs whose units differ by a power of ten; each number is in one pair at most.
    """
    return rates_in(Signals(log, (), (), Stated.by(log.files)), paths)


def rates_in(signals: Signals, paths: Sequence[str]) -> dict[str, tuple[str, float]]:
    """Return the same as `rates_among`, using samples that may have been read already."""
    found = []
    signals.read(paths)
    for a, b in permutations(paths, 2):
        gridded = signals.grid((a, b))
        if gridded is None:
            continue
        step, (position, rate) = gridded
        like = follows(position, rate, step)
        power = 10.0 ** round(np.log10(max(like.slope, 1e-9)))
        if like.correlation > SURELY and abs(like.slope / power - 1) < SAME:
            found.append((like.correlation, a, b, 1 / power))
    pairs: dict[str, tuple[str, float]] = {}
    for _, a, b, times in sorted(found, reverse=True):
        taken = {one for q, (w, _) in pairs.items() for one in (q, w)}
        if not taken & {a, b}:
            pairs[a] = (b, times)
    return pairs


def moved_to(guess: Guess, path: str) -> Guess:
    """Return the guess moved to another of its candidates."""
    if path == guess.path:
        return guess
    rest = tuple(p for p in (guess.path, *guess.others) if p not in ("", path))
    return replace(guess, path=path, others=rest[:3], field=None, reasons=())


class Signals:
    """The samples of all candidates, read once, and put on a common grid on request."""

    def __init__(
        self, log: LogReport, guesses: Iterable[Guess], angles: Collection[str], stated: Stated
    ) -> None:
        self.stated = stated
        self._clocks = {t.topic: "header" if t.stamped else "log" for t in log.topics}
        if any(t.skew_s is not None and abs(t.skew_s) > SIMULATED_S for t in log.topics):
            self._clocks = dict.fromkeys(self._clocks, "log")
        self._files, self._angles = log.files, angles
        self.found: dict[str, Samples] = {}
        self.read([p for g in guesses for p in (g.path, *g.others) if p])

    def read(self, paths: Iterable[str]) -> None:
        """Read the samples of further paths."""
        more = (p for p in paths if p not in self.found)
        specs = {p: SignalSpec(p, clock=_clock(p, self._clocks)) for p in more}  # type: ignore[arg-type]
        try:
            series = read_signals(self._files, specs) if specs else {}
        except OverBudget:
            raise
        except GroundedError:
            series = _one_by_one(self._files, specs)
        for path, one in series.items():
            try:
                found = tidy(path, one, unwrap="@rpy" in path)
            except GroundedError:
                continue
            self.found[path] = _unwound(found) if path in self._angles else found

    def grid(self, paths: Sequence[str]) -> tuple[float, list[Floats]] | None:
        """Interpolate signals on a common grid.

        Returns:
            Its step [s] and one column per path; None if the signals don't overlap.
        """
        if not all(path in self.found and len(self.found[path].t) > 20 for path in paths):
            return None
        samples = [self.found[path] for path in paths]
        start, stop = max(s.t[0] for s in samples), min(s.t[-1] for s in samples)
        step = max(s.interval for s in samples)
        step = max(step, (stop - start) * 1e-9 / LONGEST)
        t = np.arange(start, stop, round(step * 1e9), dtype=np.int64)
        if len(t) < 20:
            return None
        at = (t - start) * 1e-9
        return step, [np.interp(at, (s.t - start) * 1e-9, s.y) for s in samples]


def _unwound(angle: Samples) -> Samples:
    """Unwrap an angle that jumps by a full turn, in radians or degrees."""
    jump, width = np.abs(np.diff(angle.y)).max(initial=0.0), np.ptp(angle.y)
    turns = [turn for turn in (2 * np.pi, 360.0) if 0.9 * turn < jump <= width < 1.02 * turn]
    return replace(angle, y=np.unwrap(angle.y, period=turns[0])) if turns else angle


def _clock(path: str, clocks: Mapping[str, str]) -> str:
    topic = max((t for t in clocks if path.strip('"').startswith(t)), key=len, default="")
    return clocks.get(topic, "log")


def _one_by_one(files: Sequence[Path], specs: Mapping[str, SignalSpec]) -> dict[str, Series]:
    found: dict[str, Series] = {}
    for path, spec in specs.items():
        try:
            found |= read_signals(files, {path: spec})
        except GroundedError:
            continue
    return found


@dataclass(frozen=True)
class Follows:
    """Correlation of two signals, and how many times as large the second is."""

    correlation: float
    slope: float


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
    if len(a) < 20 or a.std() < 1e-9 or b.std() < 1e-9:
        return Follows(0.0, 1.0)
    a, b = a - a.mean(), b - b.mean()
    return Follows(float(a @ b / np.sqrt((a @ a) * (b @ b))), float(a @ b / (a @ a)))


def scale_of(slope: float) -> tuple[float, str]:
    """Return the factor that a rate must be multiplied by, and a phrase on sign and unit."""
    sign, size = np.sign(slope), abs(slope)
    opposite = " with the OPPOSITE SIGN" if sign < 0 else ""
    if abs(size / DEGREE - 1) < SAME:
        return float(sign / DEGREE), f"{opposite}, in DEGREES per second"
    if abs(size * DEGREE - 1) < SAME:
        return float(sign * DEGREE), f"{opposite}, whose values are in DEGREES"
    return float(sign), opposite
