"""Find kinematic rows that contradict their own sensors, and the change of a log that fixes them.

A sensor with a wrong unit, sign or column breaks every row that it enters. The right change fixes
all of these rows at once; a wrong one fixes some and breaks others. For example x' = u cos psi -
v sin psi together with psi' = r distinguishes degrees in r from radians in psi.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.frozen import wrapped
from grounded.instruments.finding import DEGREES, Finding, unusable
from grounded.instruments.kinematics.relations import AGREE, TURNED_AWAY, Turned, travelled
from grounded.instruments.kinematics.rows import Gap, Row, gaps, per_step
from grounded.instruments.kinematics.swapped import exchanged
from grounded.instruments.predictions.short_runs import missed
from grounded.instruments.units.odd_trial import Odd, spread
from grounded.instruments.units.other_units import FACTORS, described
from grounded.model import Model
from grounded.places import integrals
from grounded.result import listed, per_second, with_unit
from grounded.trial import Trial

BAD, GROSS = 0.5, 0.7  # unexplained share of the motion: examined, and reported
MENDED, BETTER = 0.4, 3.0  # a fixed row: largest share left, and factor by which it must fall
CLOSE, ROUNDING = 2.0, 0.02  # factor of the best change's remainder within which others are as good
FOLDED = 0.8  # [rad] largest rms error modulo a turn, of a heading in degrees; by chance 1.8
TOLD = 0.8  # of the other's error: below it one explanation is better


@dataclass(frozen=True)
class Change:
    """A possible fault: states that are `factor` times too large, or two that are exchanged."""

    states: tuple[int, ...]
    factor: float = 1.0

    @property
    def swap(self) -> bool:
        """Whether two columns are exchanged."""
        return self.factor == 1.0

    @property
    def corrected(self) -> bool:
        """Whether it is corrected here: a sign or degrees. Other faults raise an error."""
        return self.factor == -1.0 or abs(self.factor / DEGREES - 1) < 1e-9

    def mended(self, trial: Trial) -> Trial:
        """Return the trial without this fault."""
        if not self.swap:
            return Odd(0, self.factor, self.states).mended(trial)
        x = np.array(trial.states)
        x[:, self.states] = x[:, self.states[::-1]]
        return replace(trial, states=x)


@dataclass(frozen=True)
class Mismatch:
    """A change that fixes the mismatch in some trials; `others` fix it equally well."""

    trials: tuple[int, ...]
    change: Change
    others: tuple[Change, ...] = ()


def _mending(
    model: Model, trials: Sequence[Trial], rows: Sequence[Row], shown: Sequence[int]
) -> list[Mismatch]:
    """Return the fewest changes after which all rows agree.

    Empty if the rows agree already, or if no set of changes fixes all of them.
    """
    every = [gaps(model, trial, rows) for trial in trials]
    odd = [k for k, one in enumerate(every) if any(gap.share > BAD for gap in one.values())]
    some, found = [trials[k] for k in odd], []
    before = _pooled([every[k] for k in odd])
    while bad := {row for row, share in before.items() if share > BAD}:
        choices = {}
        for change in _changes(model, bad, rows):
            after = _pooled([gaps(model, change.mended(trial), rows) for trial in some])
            entered = [row for row in rows if row.states & set(change.states)]
            if all(_agrees(row, before, after, bad) for row in entered if row in before):
                choices[change] = (len(bad & set(entered)), after)
        most = max((count for count, _ in choices.values()), default=0)
        left = {c: sum(after.values()) for c, (count, after) in choices.items() if count == most}
        least = CLOSE * min(left.values(), default=0.0) + ROUNDING
        best = _ranked(model, some, [c for c, one in left.items() if one <= least], shown)
        if not best:
            return []  # a partial explanation does not count
        found.append(Mismatch(tuple(odd), best[0], tuple(best[1:])))
        some, before = [best[0].mended(trial) for trial in some], choices[best[0]][1]
    return found


def explained(
    model: Model, trials: Sequence[Trial], rows: Sequence[Row], shown: Sequence[int]
) -> list[Mismatch]:
    """Return the fewest changes after which all rows agree.

    If a constant heading offset explains the mismatch about as well, it is preferred: the rows of
    the two positions are then ignored.

    Args:
        model: however crude.
        trials: of this model's states.
        rows: kinematic rows, see `rows.kinematic_rows`.
        shown: indices of the states with a sensor.

    Returns:
        Empty if the rows agree already, or if no set of changes fixes all of them.
    """
    found, away = _mending(model, trials, rows, shown), _away(model, trials, shown)
    if not found or away is None:
        return found
    relation, offset = away
    plus = np.where(np.arange(model.n) == relation.k, offset, 0.0)
    turned_back = [replace(trial, states=trial.states + plus) for trial in trials]
    mended = list(trials)
    for one in found:
        for k in one.trials:
            mended[k] = one.change.mended(mended[k])
    left, other = (
        sum(_pooled([gaps(model, trial, rows) for trial in some]).values())
        for some in (mended, turned_back)
    )
    if left < TOLD * other:
        return found
    return _mending(model, trials, _but(rows, relation), shown)


def _away(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> tuple[Turned, float] | None:
    """Return the constant angle [rad] between a heading and the course travelled; None if small."""
    if (away := travelled(model, trials, shown)) is None:
        return None
    relation, found = away
    if found.agrees <= AGREE or abs(found.offset) <= TURNED_AWAY:
        return None
    return relation, found.offset


def _but(rows: Sequence[Row], relation: Turned) -> list[Row]:
    return [row for row in rows if row.i not in (relation.i, relation.j)]


def _agrees(
    row: Row, before: Mapping[Row, float], after: Mapping[Row, float], bad: set[Row]
) -> bool:
    """Check whether a row that a change affects is fixed, or stays good."""
    left = after.get(row, np.inf)
    return left < (min(MENDED, before[row] / BETTER) if row in bad else MENDED)


def _pooled(every: Sequence[Mapping[Row, Gap]]) -> dict[Row, float]:
    """Return the unexplained share of each row over several trials (rms)."""
    found: dict[Row, list[float]] = {}
    for one in every:
        for row, gap in one.items():
            found.setdefault(row, []).append(gap.share)
    return {row: float(np.sqrt(np.mean(np.square(some)))) for row, some in found.items()}


def _changes(model: Model, bad: set[Row], rows: Sequence[Row]) -> Iterator[Change]:
    """Yield candidate faults: of one signal, of all positions or velocities, of two exchanged."""
    units = list(model.states.values())
    touched = sorted({i for row in bad for i in row.states})
    like = {units[row.i] for row in bad}
    owns = tuple(sorted(row.i for row in rows if units[row.i] in like and units[row.i] == "m"))
    speeds = tuple(i for i in touched if units[i] == "m/s")
    for i in touched:
        yield Change((i,), -1.0)
        if units[i] in ("rad", "rad/s"):
            yield from (Change((i,), f) for f in (DEGREES, 1 / DEGREES))
    single = [(i,) for i in touched if units[i] in ("m", "m/s")]
    for group in dict.fromkeys([*single, *(g for g in (owns, speeds) if len(g) > 1)]):
        yield from (Change(group, f) for f in FACTORS)
    for row in rows:  # a compass with the opposite sign, and the gyro as well
        if model.angle_mask[row.i] and len(row.by) == 1 and row.i in touched:
            yield Change((row.i, *row.by), -1.0)
    for pair in combinations(touched, 2):
        if units[pair[0]] == units[pair[1]] and units[pair[0]] in ("m", "m/s"):
            yield Change(pair)


def _ranked(
    model: Model, trials: Sequence[Trial], some: Sequence[Change], shown: Sequence[int]
) -> list[Change]:
    """Sort changes, likeliest first.

    Too large comes before too small, and one signal before several, unless the model predicts the
    trials clearly better with another change.
    """
    order = sorted(some, key=lambda c: (not c.factor >= 1 and c.factor != -1, len(c.states)))
    if len(order) < 2:
        return order

    def error(change: Change) -> float:
        mended = [change.mended(trial) for trial in trials]
        each = [missed(model, t, shown, shown, spread(t, shown)) for t in mended]
        return float(np.nanmedian(each))

    errors = [error(change) for change in order]
    best = min(range(len(order)), key=lambda k: errors[k])
    if errors[best] < TOLD * errors[0]:
        order.insert(0, order.pop(best))
    return order


def stop_at(model: Model, trials: Sequence[Trial], found: Sequence[Mismatch]) -> None:
    """Raise an error for lengths in another unit and for exchanged columns.

    Raises:
        GroundedError: naming the trials, the states and the correction in [log].
    """
    stops = [one for one in found if not one.change.corrected]
    if not stops:
        return
    choices = []
    for mismatch in stops:
        first, others = mismatch.change, mismatch.others
        others = tuple(c for c in others if not any(_within(c, o) for o in (first, *others)))
        choices.append((first, *others))
    scales = "the paths and scales in [log] (multiply the scale; a missing one is 1)"
    in_log, in_program = (
        "; ".join(", or else ".join(_said(model, c, log=log) for c in some) for some in choices)
        for log in (True, False)
    )
    odd = "positions don't move as velocities and angles imply: "
    raise unusable(
        trials,
        stops[0].trials,
        odd + in_log,
        f"Correct the log, or {scales}",
        odd + in_program,
    )


def _within(a: Change, b: Change) -> bool:
    """Check whether b is the same fault of more signals than a."""
    return a.factor == b.factor and set(a.states) < set(b.states)


@dataclass(frozen=True)
class Folded:
    """An angle (state i) in degrees that was unwrapped in radians, and in which trials.

    Resampled as radians, 350 degrees become 350 - 56 x 2 pi, so steps of more than pi degrees are
    lost and dividing the trial by 57.3 does not restore them.
    """

    state: int
    trials: tuple[int, ...]

    def told(self, model: Model) -> str:
        """Return a clause that continues a sentence after the angle's name."""
        unit = list(model.states.values())[self.state]
        return f"is in degrees, but was unwrapped as an angle in {unit}"


def folded(model: Model, trials: Sequence[Trial], rows: Sequence[Row]) -> list[Folded]:
    """Return the angles in degrees that were unwrapped as if they were in radians.

    Args:
        model: however crude.
        trials: of this model's states.
        rows: kinematic rows, see `rows.kinematic_rows`.
    """
    found = []
    for row in rows:
        if not model.angle_mask[row.i]:
            continue
        some = tuple(k for k, trial in enumerate(trials) if _folds(model, trial, row))
        if some:
            found.append(Folded(row.i, some))
    return found


def _folds(model: Model, trial: Trial, row: Row) -> bool:
    """Return whether an angle turns 57.3 times as far as its row says, but for whole turns."""
    steps = list(per_step(model, trial, [row]))
    moved, said = (
        np.concatenate([np.empty(0), *(pair[k][:, row.i] for pair in steps)]) for k in (0, 1)
    )
    turned = DEGREES * said
    if len(moved) < 20 or not (np.abs(turned) > np.pi).mean() > 0.01:
        return False
    off = wrapped((moved - turned)[:, None], [True])
    plain = wrapped((moved - said)[:, None], [True])
    return bool(np.sqrt((off**2).mean()) < min(FOLDED, np.sqrt((plain**2).mean()) / 2))


def stop_at_folded(model: Model, trials: Sequence[Trial], rows: Sequence[Row]) -> None:
    """Raise an error for an angle in degrees that was unwrapped as if it were in radians.

    Raises:
        GroundedError: with the scale with which to ingest the log again.
    """
    for one in folded(model, trials, rows):
        name = model.state_names[one.state]
        ids = tuple(trials[k].id for k in one.trials if trials[k].id)
        where = f"in trial{'s' * (len(ids) > 1)} {listed(ids)} " if ids else ""
        raise GroundedError(
            f"{where}{name} {one.told(model)} when the log was ingested: multiply the scale in "
            f"[log.state.{name}] by {1 / DEGREES:.8g} (a missing scale is 1) or write "
            f"{model.states[name]} into the log, discard {'these trials' if ids[1:] else 'it'} and "
            f"ingest {'their logs' if ids[1:] else 'the log'} again",
            then=NextCommand("discard", ids) if ids else None,
        )


def _said(model: Model, change: Change, *, log: bool) -> str:
    names = [model.state_names[i] for i in change.states]
    if change.swap:
        return exchanged(listed(names))
    if change.factor == -1.0:
        tables = listed(f"[log.state.{name}]" for name in names)
        how = f"multiply the scale in {tables} by -1" if log else "reverse it"
        return f"{listed(names)}: the sign looks wrong, {how}"
    return ", ".join(described(model, i, change.factor, log=log) for i in change.states)


def unexplained(model: Model, trials: Sequence[Trial], rows: Sequence[Row]) -> Iterator[Finding]:
    """Yield a finding for each row that most trials contradict grossly.

    Rows q' = w, and positions where the heading has an offset, are reported elsewhere.

    Args:
        model: however crude.
        trials: corrected as far as possible.
        rows: kinematic rows.
    """
    away = _away(model, trials, range(model.n)) if rows else None
    rows = rows if away is None else _but(rows, away[0])
    plain = {one.i for one in integrals(model)}
    every = [gaps(model, trial, rows) for trial in trials]
    for row in rows:
        some = [one[row] for one in every if row in one]
        if row.i in plain or not some or np.median([gap.share for gap in some]) < GROSS:
            continue
        if np.median([gap.varying for gap in some]) < BAD:
            continue  # at rest in a current
        name, *by = (model.state_names[i] for i in (row.i, *row.by))
        rate = float(np.median([gap.rate for gap in some]))
        what = listed(by)
        off = with_unit(f"{rate:.3g}", per_second(model.states[name]))
        text = (
            f"does not move as {what} {'imply' if len(by) > 1 else 'implies'} (its rate is off by "
            f"{off}): check units, axes and signs"
        )
        yield Finding(name, text, "mismatch")
