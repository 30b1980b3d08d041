"""START HERE: tell how logs came about, by scoring the accounts of the table.

Every account is scored by what it leaves unexplained: the kinematic rows of the trial as it would
be otherwise (`kinematics`), and the motion that the model, calibrated on it, misses (`motion`), in
nats. No physics breaks a row, so an account of rows is told if it mends every row that it
touches; the motion then decides between accounts that mend the same rows. What rows can't show is
told by the motion alone, and there "as logged" may use any gains and signs of its inputs, whereas
an account must stay near the model's: a model that is only wrong gains nothing by a fault of a log.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.accounts.kinematics import Gap, Row, away, gaps, kinematic_rows, turned
from grounded.accounts.levels import EXPLAINED, FACTOR, HALF, HINT, MARGIN, PART, SMALL
from grounded.accounts.motion import (
    SHORTLIST,
    Ahead,
    Fit,
    known_states,
)
from grounded.accounts.table import Account, Term, Told, accounts
from grounded.frozen import Array, white_noise
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial
from grounded.units import RPM

OF_A_UNIT = 0.015  # tolerance of its ratio
JUDGED_S = 0.5  # [s] of predictions
SNAPPED = np.deg2rad(4)  # a heading that is off by a right angle
TRIALS, STARTS = 4, 40  # trials, and samples of each, that predictions are made from
NOISE_ALONE = 1.3  # times its white noise: the standard deviation of a dead sensor


@dataclass(frozen=True)
class Verdict:
    """What is told of trials."""

    told: tuple[Told, ...]  # in the order in which they were found
    corrected: tuple[Trial, ...]  # as they would be without what is certain
    open: Mapping[Row, Gap]  # rows that no account explains, with their gaps over all trials


def judge(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> Verdict:
    """Tell how trials came about.

    Args:
        model: however crude.
        trials: of its states and inputs, of one time step.
        shown: indices of the states with a sensor.
    """
    rows, mended, told = kinematic_rows(model, shown), list(trials), list[Told]()
    known = {row.i for row in rows}  # a scale between two sensors may be uncertain
    plain = (r for r in integrals(model) if r.exact and {r.i, r.j} <= {*shown})
    rows += [Row(r.i, (r.j,), r.c) for r in plain if r.i not in known]
    with np.errstate(all="ignore"):
        for one in _ByRows(model, mended, rows, shown).told():
            told.append(one)
            mended = _without(one, mended)
        left = _pooled([gaps(model, trial, rows) for trial in mended])
        told += _by_motion(model, mended, rows, shown)
    corrected = list(trials)
    for one in (one for one in told if one.certain):
        corrected = _without(one, corrected)
    return Verdict(tuple(told), tuple(corrected), {row: left[row] for row in _bad(left)})


def _without(told: Told, trials: Sequence[Trial]) -> list[Trial]:
    """Return trials without a fault, where they have it."""
    return [told.account.mended(t) if k in told.trials else t for k, t in enumerate(trials)]


def contradicted(model: Model, trial: Trial, shown: Sequence[int], account: Account) -> bool:
    """Check whether the model predicts a trial clearly better as logged than without a fault."""
    known, ones = known_states(trial, shown), np.ones(model.m)
    with np.errstate(all="ignore"):  # a command at its limit may make a constant rate
        logged, mended = (
            Ahead(model, one, known, STARTS, constant=False, horizon=JUDGED_S)
            for one in (trial, account.mended(trial))
        )
        enough = logged.enough and mended.enough
        return enough and mended.plain(ones).missed - logged.plain(ones).missed > HINT


# --- by rows --------------------------------------------------------------------------------------


def _bad(found: Mapping[Row, Gap]) -> list[Row]:
    return [row for row, gap in found.items() if gap.share > PART]


def _pooled(every: Sequence[Mapping[Row, Gap]]) -> dict[Row, Gap]:
    """Return the gap of each row over several trials (rms)."""
    each = {row: [one[row] for one in every if row in one] for one in every for row in one}
    return {
        row: Gap(*np.sqrt(np.mean(np.square(some), axis=0)).tolist()) for row, some in each.items()
    }


class _ByRows:
    """What kinematic rows tell of trials."""

    def __init__(
        self, model: Model, trials: Sequence[Trial], rows: Sequence[Row], shown: Sequence[int]
    ) -> None:
        self.model, self.trials, self.rows, self.shown = model, trials, rows, shown
        self.each = [gaps(model, trial, rows) for trial in trials]
        self.sound = [k for k, one in enumerate(self.each) if not _bad(one)]
        self.plane = turned(model) if any(len(row.by) > 1 for row in rows) else None
        self.units = list(model.states.values())

    def told(self) -> list[Told]:
        """Return the fewest accounts after which all rows agree, of trials with one fault."""
        if len(self.sound) == len(self.trials):
            return []
        groups = dict[frozenset[Row], list[int]]()
        for k in (k for k in range(len(self.trials)) if k not in self.sound):
            groups.setdefault(frozenset(_bad(self.each[k])), []).append(k)
        self.table = self._table()
        found, queue = dict[Account, dict[int, Told]](), list(groups.values())
        while queue:
            story, group = list[Told](), queue.pop()
            some, before = [self.trials[k] for k in group], _pooled([self.each[k] for k in group])
            while (bad := _bad(before)) and len(story) <= len(bad) + len(self.rows):
                if (best := self._best(some, before)) is None:
                    break
                story.append(best)
                some = [best.account.mended(trial) for trial in some]
                before = _pooled([gaps(self.model, trial, self.rows) for trial in some])
            if not story and len(group) > 1:
                queue += [[k] for k in group]  # each may have a fault of its own
            for best in story:
                same = replace(best.account, offset=0.0)
                found.setdefault(same, {}).update(dict.fromkeys(group, best))
        return [self._together(some) for some in found.values()]

    def _together(self, some: Mapping[int, Told]) -> Told:
        """Return one account of several trials; an offset is their mean, or a right angle."""
        (first, best), *_ = some.items()
        account, moved = best.account, None
        if account.fitted:
            turn = float(np.angle(np.mean([np.exp(1j * b.account.offset) for b in some.values()])))
            right = float(np.rint(turn / (np.pi / 2)) * np.pi / 2)
            account = replace(account, offset=right if abs(turn - right) < SNAPPED else turn)
        if account.kind == "dead":
            j, x = account.columns[0], self.trials[first].states
            i = next(row.i for row in self.rows if j in row.by and row in self.each[first])
            moved = (i, float(np.nanmean(x[:, j])), float(np.nanmax(x[:, i]) - np.nanmin(x[:, i])))
        which, whole = tuple(sorted(some)), len(some) == len(self.trials)
        others = () if self.sound else best.others
        return Told(account, which, best.gain, others, whole, moved=moved)

    def _table(self) -> list[Account]:
        """Return the accounts of these trials, of columns that rows relate as well."""
        columns: tuple[int, ...] = ()
        if self.plane is not None:
            i, j, k = self.plane
            rate = next((row.by[0] for row in self.rows if row.i == k and len(row.by) == 1), -1)
            own = {k for row in self.rows if row.i in (i, j) for k in row.by}
            columns = (k, rate, *(k for k in sorted(own) if self.units[k] == "m/s"))
        related = sorted({k for row in self.rows for k in row.states})
        inputs = [trial.inputs for trial in self.trials]
        table = list(accounts(self.model, self.shown, related, columns, inputs))
        return [one for one in table if Term.ROWS in one.terms]

    def _dead(self, trials: Sequence[Trial], before: Mapping[Row, Gap]) -> Iterator[Account]:
        """Yield the velocities that show zero, or noise alone, in a row that is bad.

        A wrong unit or sign would keep the shape of the motion. Most of a motion is missing, and
        not by a mere current; a hull's speed sideways, one of several in the rate of a position, is
        often noise alone.
        """
        size = np.array([_rms(trial.states) for trial in trials])
        noise = np.array([white_noise(trial.states) for trial in trials])
        dead = np.all(size <= NOISE_ALONE * noise + 1e-299, axis=0)
        for row in (row for row, gap in before.items() if gap.share > HALF):
            alone = len(row.by) == 1 or self.units[row.i] in ("rad", "deg")
            for j in row.by if alone and before[row].varying > PART else ():
                if self.units[j].endswith("/s") and dead[j]:
                    yield Account("dead", (j,))

    def _best(self, trials: Sequence[Trial], before: Mapping[Row, Gap]) -> Told | None:
        """Return the account that best mends the rows of trials, its gain and those as good."""
        bad, n = frozenset(k for row in _bad(before) for k in row.states), self.model.n
        cost = dict[Account, float]()
        for account in (*self._dead(trials, before), *self.table):
            states = frozenset(k for k in account.touched if k < n)
            if not (states & bad if len(account.columns) > 1 else states <= bad):
                continue
            mended = [account.mended(trial) for trial in trials]
            if account.fitted and self.plane is not None:
                turn = away(self.model, mended, self.rows, self.plane)
                account = replace(account, offset=turn)
                mended = [account.mended(trial) for trial in trials]
            entered = [row for row in before if row.states & account.touched]
            after = _pooled([gaps(self.model, one, entered) for one in mended])
            if account.kind == "dead":  # nothing is left to disagree
                after = dict.fromkeys(entered, Gap(0.0, 0.0, 0.0, 1.0, 1.0))
            agree = all(row in after and _agrees(before[row], after[row]) for row in entered)
            if agree and _of_this_size(account, after):
                gained = sum(_nats(after[row]) - _nats(before[row]) for row in entered)
                cost[account] = gained + account.price
        if not cost:
            return None
        # accounts that mend the same rows are told apart by the motion
        least = min(cost.values())
        near = [account for account in cost if cost[account] < least + 3 * MARGIN]
        if len(near) > 1 and "dead" not in {one.kind for one in near}:
            for account in near:
                run = account.mended(trials[0])
                made = Ahead(
                    self.model, run, known_states(run, self.shown), STARTS, horizon=JUDGED_S
                )
                if made.enough:
                    cost[account] += made.best([np.ones(self.model.m)], free=False).missed
        first, *rest = sorted(near, key=lambda account: cost[account])
        others = tuple(
            one
            for one in rest
            if cost[one] < cost[first] + MARGIN and not one.touched > first.touched
        )
        return Told(first, (), -least, others)


def _rms(x: Array) -> Array:
    """Return the rms of the known samples of some states (T, n), all but 0 if there are none."""
    known = np.isfinite(x)
    squares = np.where(known, x, 0.0) ** 2
    return np.asarray(np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)) + 1e-300)


def _nats(gap: Gap) -> float:
    return float(np.log(max(gap.share, SMALL)))


def _agrees(before: Gap, after: Gap) -> bool:
    """Check whether a row that an account touches is mended, or stays good."""
    return after.share <= (before.share / FACTOR if before.share > PART else PART)


def _of_this_size(account: Account, after: Mapping[Row, Gap]) -> bool:
    """Check whether all rows together are right in size, where an account names a unit."""
    power = sum(gap.power for gap in after.values())
    ratio = sum(gap.power * gap.ratio for gap in after.values()) / max(power, 1e-300)
    gross = abs(np.log(abs(account.factor))) > np.log(RPM)
    off = abs(np.log(max(ratio, 1e-9)))
    return account.kind != "unit" or bool(off < (EXPLAINED if gross else OF_A_UNIT))


# --- by motion ------------------------------------------------------------------------------------


def _by_motion(
    model: Model, trials: Sequence[Trial], rows: Sequence[Row], shown: Sequence[int]
) -> Iterator[Told]:
    """Yield the account that predictions of some trials show and none contradicts, if any."""
    some = _examined(trials, shown)
    every = accounts(model, shown, inputs=[trials[k].inputs for k in some])
    table = [one for one in every if Term.MOTION in one.terms]
    examined = {k: _Seen(model, trials[k], rows, shown) for k in some}
    found = dict[Account, dict[int, tuple[Fit, Fit]]]()
    for k, one in examined.items():
        for account, fits in one.better(table):
            found.setdefault(account, {})[k] = fits
    against = {account: any(one.worse(account) for one in examined.values()) for account in found}
    # a trial in another unit may be one of many; columns are exchanged in all of a kind
    whole = {a: fits for a, fits in found.items() if not against[a] or a.kind == "unit"}
    most = max(map(len, whole.values()), default=0)
    cost = {
        account: float(np.mean([after.missed for _, after in fits.values()])) + account.price
        for account, fits in whole.items()
        if len(fits) == most
    }
    if not cost:
        return
    best, *others = sorted(cost, key=lambda account: cost[account])
    near = tuple(one for one in others if cost[one] < cost[best] + MARGIN and one.kind == best.kind)
    k, (before, after) = next(iter(whole[best].items()))
    i = int(np.argmin(after.share / before.share))
    seen = (i, float(before.rms[i]), float(after.rms[i]), JUDGED_S)
    gain = float(np.mean([b.missed - a.missed for b, a in whole[best].values()]))
    which = tuple(whole[best]) if against[best] else tuple(range(len(trials)))
    yield Told(best, which, gain, near, len(which) == len(trials), seen)


def _examined(trials: Sequence[Trial], shown: Sequence[int]) -> list[int]:
    """Return the trials that are predicted: some, and those of another size than the others."""
    some = {*range(0, len(trials), max(1, -(-len(trials) // TRIALS)))}
    size = np.array([_rms(t.states[:, list(shown)]) for t in trials])
    apart = np.abs(np.log(size / np.median(size, axis=0))).max(axis=1, initial=0.0)
    return sorted(some | {int(k) for k in np.flatnonzero(apart > np.log(RPM))[:TRIALS]})


class _Seen:
    """A trial as it would be by one account or another, and what the model misses of each."""

    def __init__(
        self, model: Model, trial: Trial, rows: Sequence[Row], shown: Sequence[int]
    ) -> None:
        self.model, self.trial, self.known = model, trial, known_states(trial, shown)
        self.gaps, self.gains = gaps(model, trial, rows), dict[Account, float]()
        self.logged = self._without(Account(""))

    def _without(self, account: Account) -> Ahead:
        """Return the predictions of the trial without a fault."""
        run = account.mended(self.trial)
        return Ahead(self.model, run, self.known, STARTS, horizon=JUDGED_S)

    def gain(self, account: Account) -> float:
        """Return by how much less the model as it is misses without a fault [nats]."""
        if account not in self.gains:
            known = {*self.known, *range(self.model.n, self.model.n + self.model.m)}
            both = (self.logged, self._without(account)) if account.touched <= known else ()
            if both and all(one.enough for one in both):
                before, after = (one.plain(np.ones(self.model.m)).missed for one in both)
                self.gains[account] = float(np.nan_to_num(before - after))
        return self.gains.setdefault(account, 0.0)

    def better(self, table: Iterable[Account]) -> Iterator[tuple[Account, tuple[Fit, Fit]]]:
        """Yield the accounts that the calibrated model clearly prefers, with both fits."""
        likely = sorted((a for a in table if self.gain(a) > HINT), key=lambda a: -self.gains[a])
        for account in [one for one in likely if self._allowed(one)][:SHORTLIST]:
            mended = self._without(account)
            if fits := _compared(self.model, self.logged, mended, account):
                yield account, fits

    def worse(self, account: Account) -> bool:
        """Return whether the trial is better as logged."""
        return self.gain(account) < -HINT and self._allowed(account)

    def _allowed(self, account: Account) -> bool:
        """Return whether no kinematic row contradicts an account."""
        entered = [row for row in self.gaps if row.states & account.touched]
        after = gaps(self.model, account.mended(self.trial), entered)
        return all(row in after and _agrees(self.gaps[row], after[row]) for row in entered)


def _compared(
    model: Model, logged: Ahead, mended: Ahead, account: Account
) -> tuple[Fit, Fit] | None:
    """Return both calibrated fits; None if the account is not clearly better after calibration."""
    ones, unit = np.ones(model.m), account.kind == "unit"
    free = mended.best([ones])
    sent = [k - model.n for k in account.touched if k >= model.n]
    size = np.abs(np.log(np.maximum(free.gains[sent], 1e-9)))
    if (size > (abs(np.log(account.factor)) / 3 if unit else np.log(FACTOR))).any():
        return None  # the inputs act otherwise than in the model
    after = mended.best([ones], free=False) if unit else free
    if unit:  # a factor that takes an input away is no unit
        dead = np.where(np.isin(np.arange(model.m), sent), 0.0, ones)
        before = logged.best([ones, dead], free=False)
    else:
        before = logged.best([ones, -ones, 0.0 * ones, *(ones - 2 * np.eye(model.m))])
    better = before.missed - after.missed > MARGIN + account.price
    return (before, after) if better and (after.share < HALF * before.share).any() else None
