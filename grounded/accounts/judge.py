"""START HERE: tell how logs came about, by scoring the accounts of the table.

Every account is scored by what it leaves unexplained: the kinematic rows of the trial as it would
be otherwise (`kinematics`), and the motion that the model, calibrated on it, misses (`motion`), in
nats. No physics breaks a row, so an account of rows is told if it mends every row that it
touches; the motion then decides between accounts that mend the same rows. What rows can't show is
told by the motion alone, and there "as logged" may use any gains and signs of its inputs, whereas
an account must stay near the model's: a model that is only wrong gains nothing by a fault of a log.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from grounded.accounts.kinematics import (
    Gap,
    Row,
    Turned,
    away,
    folded,
    gaps,
    kinematic_rows,
    turned,
)
from grounded.accounts.motion import (
    HALF_ERROR,
    HINT,
    LIKE,
    MARGIN,
    Ahead,
    Fit,
    horizon_of,
    plainly_missed,
)
from grounded.accounts.table import Account, Term, Told, accounts, versions
from grounded.frozen import Array, white_noise
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial

BAD, MENDED = 0.4, 0.35  # share of a row's motion that is unexplained: examined, and mended
BETTER = 3.0  # factor by which a bad row's share must fall
ROUNDING = 0.01  # of a row's motion: smaller shares count as this
OF_A_UNIT, GROSSLY, OF_TEN = 0.015, 20.0, 0.1  # tolerance of a unit's ratio; of far larger ones
TURNED_AWAY = np.deg2rad(20)  # more than any side slip causes
SNAPPED = np.deg2rad(4)  # offsets this near to a right angle are one
NEAR_NATS = 2.5  # [nats] within which accounts of rows are compared by the motion
TRIALS, STARTS, FEWER = 4, 80, 40  # trials and samples that predictions are made from
SHORTLIST = 8  # accounts for which the model is calibrated
NOISE_ALONE = 1.3  # times its white noise: the standard deviation of a dead sensor
UNLIKE_OTHERS = 20.0  # times as large as in other trials: a trial to be examined


@dataclass(frozen=True)
class Verdict:
    """What is told of trials.

    Args:
        told: accounts in the order in which they were found.
        trials: as they would be without any fault.
        corrected: the same without what is certain alone.
        rows: the kinematic rows.
        open: the rows that no account explains, with their gaps.
        folded: angles in degrees that were unwrapped as radians, with their trials.
    """

    told: tuple[Told, ...]
    trials: tuple[Trial, ...]
    corrected: tuple[Trial, ...]
    rows: tuple[Row, ...]
    open: Mapping[Row, Gap]
    folded: Mapping[int, Sequence[int]]


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
        # dead sensors first: as noise they would look like anything
        for one in _dead(model, mended, rows):
            told.append(one)
            mended = _without(one, mended)
        for one in _by_rows(model, mended, rows, shown):
            told.append(one)
            mended = _without(one, mended)
        lost = folded(model, mended, rows)
        left = _pooled([gaps(model, trial, rows) for trial in mended])
        for one in [] if lost else _by_motion(model, mended, rows, shown):
            told.append(one)
            mended = _without(one, mended)
    corrected = list(trials)
    for one in (one for one in told if one.certain):
        corrected = _without(one, corrected)
    bad = {row: gap for row, gap in left.items() if gap.share > BAD}
    return Verdict(tuple(told), tuple(mended), tuple(corrected), tuple(rows), bad, lost)


def _without(told: Told, trials: Sequence[Trial]) -> list[Trial]:
    """Return trials without a fault, where they have it."""
    return [told.account.mended(t) if k in told.trials else t for k, t in enumerate(trials)]


def _dead(model: Model, trials: Sequence[Trial], rows: Sequence[Row]) -> Iterator[Told]:
    """Yield the velocities that show zero, or noise alone, in a row that is bad.

    A wrong unit or sign would keep the shape of the motion.
    """
    units, each = list(model.states.values()), dict[int, dict[int, tuple[int, float, float]]]()
    for k, trial in enumerate(trials):
        found, noise = gaps(model, trial, rows), NOISE_ALONE * white_noise(trial.states)
        # most of a motion is missing, and not by a mere current; a hull's speed sideways, one of
        # several in the rate of a position, is often noise alone
        for row in (r for r, gap in found.items() if gap.share > HALF_ERROR and gap.varying > BAD):
            if len(row.by) > 1 and units[row.i] not in ("rad", "deg"):
                continue
            reach = float(np.nanmax(trial.states[:, row.i]) - np.nanmin(trial.states[:, row.i]))
            for j in (j for j in row.by if units[j].endswith("/s")):
                mean, spread = (float(of(trial.states[:, j])) for of in (np.nanmean, np.nanstd))
                if max(abs(mean), spread) <= noise[j]:
                    each.setdefault(j, {})[k] = (row.i, mean, reach)
    for j, moved in sorted(each.items()):
        some = tuple(moved)
        whole = len(some) == len(trials)
        yield Told(Account("dead", (j,)), some, 0.0, whole=whole, moved=moved[some[0]])


def contradicted(
    model: Model, trial: Trial, shown: Sequence[int], account: Account, *, constant: bool = True
) -> bool:
    """Check whether the model predicts a trial clearly better as logged than without a fault.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: indices of the states with a sensor.
        account: the fault, of another trial.
        constant: remove a constant rate of each state, which a command at its limit may make.
    """
    known, ones = _known(trial, shown), np.ones(model.m)
    seconds = horizon_of(trial, known)
    logged, mended = (
        Ahead(model, one, known, STARTS, constant=constant, horizon=seconds)
        for one in (trial, account.mended(trial))
    )
    if not (logged.enough and mended.enough) or not np.isfinite(trial.inputs).all():
        return False
    with np.errstate(all="ignore"):
        return mended.plain(ones).missed - logged.plain(ones).missed > HINT


# --- by rows --------------------------------------------------------------------------------------


def _by_rows(
    model: Model, trials: Sequence[Trial], rows: Sequence[Row], shown: Sequence[int]
) -> list[Told]:
    """Return the fewest accounts after which all rows agree, of trials with the same bad rows."""
    each = [gaps(model, trial, rows) for trial in trials]
    groups = dict[frozenset[Row], list[int]]()
    for k, one in enumerate(each):
        groups.setdefault(frozenset(_bad(one)), []).append(k)
    sound = [trials[k] for k in groups.pop(frozenset(), [])]
    usual = None
    if sound:
        usual = np.median([_spread(trial, range(model.n)) for trial in sound], axis=0)
    if not groups:
        return []
    plane = turned(model) if any(len(row.by) > 1 for row in rows) else None
    table = _table(model, trials, rows, shown, plane)
    found = dict[Account, list[tuple[int, Account, float, tuple[Account, ...]]]]()
    queue = list(groups.values())
    while queue:
        group = queue.pop()
        some, before = [trials[k] for k in group], _pooled([each[k] for k in group])
        story = list[tuple[Account, float, tuple[Account, ...]]]()
        while bad := _bad(before):
            best = _best(model, some, rows, before, plane, shown, usual, table)
            if best is None or len(story) > len(bad) + len(rows):
                break
            story.append(best)
            some = [best[0].mended(trial) for trial in some]
            before = _pooled([gaps(model, trial, rows) for trial in some])
        if not story and len(group) > 1:
            queue += [[k] for k in group]  # each may have a fault of its own
        for account, gain, others in story:
            same = replace(account, offset=0.0)
            found.setdefault(same, []).extend((k, account, gain, others) for k in group)
    return [_together(some, len(trials), sound) for some in found.values()]


def _together(
    some: Sequence[tuple[int, Account, float, tuple[Account, ...]]],
    count: int,
    sound: Sequence[Trial],
) -> Told:
    """Return one account of several trials; an offset is their mean, or a right angle nearby."""
    trials = tuple(dict.fromkeys(k for k, *_ in some))
    _, account, gain, others = some[0]
    if account.fitted:
        turn = float(np.angle(np.mean([np.exp(1j * one.offset) for _, one, *_ in some])))
        right = float(np.rint(turn / (np.pi / 2)) * np.pi / 2)
        account = replace(account, offset=right if abs(turn - right) < SNAPPED else turn)
    return Told(account, trials, gain, () if sound else others, len(trials) == count)


def _bad(found: Mapping[Row, Gap]) -> list[Row]:
    return [row for row, gap in found.items() if gap.share > BAD]


def _best(
    model: Model,
    trials: Sequence[Trial],
    rows: Sequence[Row],
    before: Mapping[Row, Gap],
    plane: Turned | None,
    shown: Sequence[int],
    usual: Array | None,
    table: Sequence[Account],
) -> tuple[Account, float, tuple[Account, ...]] | None:
    """Return the account that best mends the rows of trials, its gain and those as good."""
    bad = _bad(before)
    some = frozenset(k for row in bad for k in row.states)
    cost = dict[Account, float]()
    for account in [*_of_bad(table, some, model.n), *_paces(model, bad, before)]:
        account, mended = _fitted(model, trials, account, rows, plane)
        if account.fitted and abs(account.offset) < TURNED_AWAY:
            continue
        entered = [r for r in before if r.states & account.touched or account.kind == "pace"]
        after = _pooled([gaps(model, one, entered) for one in mended])
        agree = all(_agrees(row, before, after) for row in entered)
        if agree and _of_this_size(account, after):
            gained = sum(_nats(after[row].share) - _nats(before[row].share) for row in entered)
            cost[account] = gained + account.price + _strange(account, mended[0], usual)
    if not cost:
        return None
    # accounts that mend the same rows are told apart by the motion
    least = min(cost.values())
    near = [account for account in cost if cost[account] < least + NEAR_NATS]
    if len(near) > 1:
        ahead = horizon_of(trials[0], shown)
        for account in near:
            cost[account] += _unpredicted(model, account.mended(trials[0]), shown, ahead)
    near.sort(key=lambda account: cost[account])
    others = tuple(
        one
        for one in near[1:]
        if cost[one] < cost[near[0]] + MARGIN and not one.touched > near[0].touched
    )
    return near[0], -least, others


def _table(
    model: Model,
    trials: Sequence[Trial],
    rows: Sequence[Row],
    shown: Sequence[int],
    plane: Turned | None,
) -> list[Account]:
    """Return the accounts of these trials, of columns that rows relate as well."""
    columns: tuple[int, ...] = ()
    if plane is not None:
        rate = next((row.by[0] for row in rows if row.i == plane.k and len(row.by) == 1), -1)
        units = list(model.states.values())
        own = {k for row in rows if row.i in (plane.i, plane.j) for k in row.by}
        columns = (plane.k, rate, *(k for k in sorted(own) if units[k] == "m/s"))
    related = sorted({k for row in rows for k in row.states})
    return list(accounts(model, shown, related, columns, [t.inputs for t in trials]))


def _of_bad(table: Sequence[Account], some: frozenset[int], n: int) -> Iterator[Account]:
    """Yield the accounts that rows can show and that concern states of rows that disagree."""
    for account in table:
        states = frozenset(k for k in account.touched if k < n)
        asked = states & some if len(account.columns) > 1 else states <= some
        if Term.ROWS in account.terms and asked:
            yield account


def _paces(model: Model, bad: Sequence[Row], before: Mapping[Row, Gap]) -> Iterator[Account]:
    """Yield that time stamps are in ms, or were taken for ms, if no row is sound."""
    if len(bad) == len(before):
        yield Account("pace", tuple(range(model.n)), 1e3, unit="ms", price=1.0)
        yield Account("pace", tuple(range(model.n)), 1e-3, unit="ms", price=1.0)


def _fitted(
    model: Model,
    trials: Sequence[Trial],
    account: Account,
    rows: Sequence[Row],
    plane: Turned | None,
) -> tuple[Account, list[Trial]]:
    """Return an account with its offset estimated, and the trials without the fault."""
    mended = [account.mended(trial) for trial in trials]
    if account.fitted and plane is not None:
        turn = away(model, mended, rows, plane)
        account = replace(account, offset=turn)
        mended = [account.mended(trial) for trial in trials]
    return account, mended


def _agrees(row: Row, before: Mapping[Row, Gap], after: Mapping[Row, Gap]) -> bool:
    """Check whether a row that an account touches is mended, or stays good."""
    if row not in after:
        return False
    bad, left = before[row].share > BAD, after[row].share
    most = min(MENDED, before[row].share / BETTER) if bad else max(MENDED, before[row].share)
    return bool(left < most)


def _of_this_size(account: Account, after: Mapping[Row, Gap]) -> bool:
    """Check whether all rows together are right in size, where an account names a unit."""
    gross = abs(np.log(abs(account.factor))) > np.log(GROSSLY)
    power = sum(gap.power for gap in after.values())
    ratio = sum(gap.power * gap.ratio for gap in after.values()) / max(power, 1e-300)
    off = abs(np.log(max(ratio, 1e-9)))
    return account.kind != "unit" or bool(off < (OF_TEN if gross else OF_A_UNIT))


def _strange(account: Account, mended: Trial, usual: Array | None) -> float:
    """Return how unlike other trials the columns of a trial are in size [nats]."""
    some = [k for k in account.touched if usual is not None and k < len(usual)]
    if usual is None or not some or account.kind == "pace":
        return 0.0
    size = _spread(mended, some)
    return float(np.minimum(np.abs(np.log(size / usual[some])), NEAR_NATS).sum())


def _spread(trial: Trial, some: Sequence[int]) -> Array:
    """Return the standard deviation of some states (len(some),); about 0 without samples."""
    x = trial.states[:, list(some)]
    known = np.isfinite(x)
    count = np.maximum(known.sum(axis=0), 1)
    mean = np.where(known, x, 0.0).sum(axis=0) / count
    return np.asarray(np.sqrt((np.where(known, x - mean, 0.0) ** 2).sum(axis=0) / count) + 1e-300)


def _nats(share: float) -> float:
    return float(np.log(max(share, ROUNDING)))


def _pooled(every: Sequence[Mapping[Row, Gap]]) -> dict[Row, Gap]:
    """Return the gap of each row over several trials (rms)."""
    found = dict[Row, list[Gap]]()
    for one in every:
        for row, gap in one.items():
            found.setdefault(row, []).append(gap)
    return {
        row: Gap(*np.sqrt(np.mean(np.square([_numbers(gap) for gap in some]), axis=0)).tolist())
        for row, some in found.items()
    }


def _numbers(gap: Gap) -> tuple[float, ...]:
    return gap.share, gap.varying, gap.rate, gap.ratio, gap.power


# --- by motion ------------------------------------------------------------------------------------


def _known(trial: Trial, shown: Sequence[int]) -> list[int]:
    return [i for i in shown if np.isfinite(trial.states[:, i]).any()]


def _unpredicted(model: Model, trial: Trial, shown: Sequence[int], ahead: float) -> float:
    """Return how much of a trial's motion the calibrated model misses [nats], at most 0."""
    made = Ahead(model, trial, _known(trial, shown), FEWER, horizon=ahead)
    if not made.enough or not np.isfinite(trial.inputs).all():
        return 0.0
    return made.best([np.ones(model.m)], free=False).missed


def _by_motion(
    model: Model, trials: Sequence[Trial], rows: Sequence[Row], shown: Sequence[int]
) -> Iterator[Told]:
    """Yield the account that predictions of some trials show and none contradicts, if any."""
    some = _examined(trials, shown)
    found = dict[Account, dict[int, tuple[Fit, Fit, float]]]()
    table = [
        one
        for one in accounts(model, shown, inputs=[trials[k].inputs for k in some])
        if Term.MOTION in one.terms
    ]
    examined = {k: _Seen(model, trials[k], rows, shown, table) for k in some}
    for k, one in examined.items():
        for account, fits in one.better():
            found.setdefault(account, {})[k] = fits
    against = {
        account: {k for k, one in examined.items() if one.worse(account)} for account in found
    }
    # a trial in another unit may be one of many; columns are exchanged in all of a kind
    whole = {
        account: fits
        for account, fits in found.items()
        if not against.get(account) or account.kind == "unit"
    }
    if not whole:
        return
    most = max(map(len, whole.values()))
    cost = {
        account: float(np.mean([after.missed for _, after, _ in fits.values()])) + account.price
        for account, fits in whole.items()
        if len(fits) == most
    }
    best, *others = sorted(cost, key=lambda account: cost[account])
    near = tuple(one for one in others if cost[one] < cost[best] + MARGIN and one.kind == best.kind)
    before, after, ahead = next(iter(whole[best].values()))
    i = int(np.argmin(after.share / before.share))
    seen = (i, float(before.rms[i]), float(after.rms[i]), ahead)
    gain = float(np.mean([b.missed - a.missed for b, a, _ in whole[best].values()]))
    every = tuple(range(len(trials))) if not against.get(best) else tuple(whole[best])
    yield Told(best, every, gain, near, len(every) == len(trials), seen)


def _examined(trials: Sequence[Trial], shown: Sequence[int]) -> list[int]:
    """Return the trials that are predicted: some, and those of another size than the others."""
    some = {*range(0, len(trials), max(1, -(-len(trials) // TRIALS)))}
    size = np.array([_spread(t, shown) for t in trials])
    apart = np.abs(np.log(size / np.median(size, axis=0))).max(axis=1, initial=0.0)
    return sorted(some | {int(k) for k in np.flatnonzero(apart > np.log(UNLIKE_OTHERS))[:TRIALS]})


class _Seen:
    """A trial as it would be by each account of a table, and what the model misses of each.

    Args:
        model: however crude.
        trial: of its states and inputs.
        rows: the kinematic rows.
        shown: indices of the states with a sensor.
        table: the accounts.
    """

    def __init__(
        self,
        model: Model,
        trial: Trial,
        rows: Sequence[Row],
        shown: Sequence[int],
        table: Sequence[Account],
    ) -> None:
        self.model, self.trial, self.rows, self.known = model, trial, rows, _known(trial, shown)
        self.seconds = horizon_of(trial, shown)
        self.logged = Ahead(model, trial, self.known, FEWER, horizon=self.seconds)
        unknown = {i for i in range(model.n) if i not in self.known}
        self.table = [one for one in table if not one.touched & unknown]
        self.gains = np.zeros(len(self.table))
        if self.logged.enough and self.table and np.isfinite(trial.inputs).all():
            each = plainly_missed(self.logged, versions(trial, [Account(""), *self.table]))
            self.gains = np.nan_to_num(each[0] - each[1:])

    def better(self) -> Iterator[tuple[Account, tuple[Fit, Fit, float]]]:
        """Yield the accounts that the calibrated model clearly prefers, with both fits."""
        left = SHORTLIST
        for k in np.argsort(-self.gains, kind="stable"):
            if self.gains[k] <= HINT or not left:
                return
            account = self.table[int(k)]
            if not self._allowed(account):
                continue
            left -= 1
            mended = account.mended(self.trial)
            ahead = Ahead(self.model, mended, self.known, FEWER, horizon=self.seconds)
            if ahead.enough and (fits := _compared(self.model, self.logged, ahead, account)):
                yield account, (*fits, self.seconds)

    def worse(self, account: Account) -> bool:
        """Return whether the trial is better as logged."""
        k = self.table.index(account) if account in self.table else -1
        return k >= 0 and bool(self.gains[k] < -HINT) and self._allowed(account)

    @cached_property
    def _gaps(self) -> dict[Row, Gap]:
        return gaps(self.model, self.trial, self.rows)

    def _allowed(self, account: Account) -> bool:
        """Return whether no kinematic row contradicts an account."""
        entered = [row for row in self._gaps if row.states & account.touched]
        after = gaps(self.model, account.mended(self.trial), entered)
        most = {row: max(MENDED, self._gaps[row].share) for row in entered}
        return all(row in after and after[row].share <= most[row] for row in entered)


def _compared(
    model: Model, logged: Ahead, mended: Ahead, account: Account
) -> tuple[Fit, Fit] | None:
    """Return both calibrated fits; None if the account is not clearly better after calibration."""
    ones, unit = np.ones(model.m), account.kind == "unit"
    free = mended.best([ones])
    sent = [k - model.n for k in account.touched if k >= model.n]
    size = np.abs(np.log(np.maximum(free.gains[sent], 1e-9)))
    if (size > (np.log(LIKE) if not unit else abs(np.log(account.factor)) / 3)).any():
        return None  # the inputs act otherwise than in the model
    after = mended.best([ones], free=False) if unit else free
    if mended.still().missed - after.missed < MARGIN * (0.5 if unit else 1.0):
        return None  # commands explain nothing
    if unit:
        before = logged.best([ones], free=False)
    else:
        signs = [np.where(np.arange(model.m) == j, -1.0, 1.0) for j in range(model.m)]
        before = logged.best([ones, -ones, 0.0 * ones, *(signs if model.m > 1 else ())])
    better = before.missed - after.missed > MARGIN + account.price
    return (before, after) if better and (after.share < HALF_ERROR * before.share).any() else None
