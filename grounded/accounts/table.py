"""The stories of how a log came about: one table, made from the units and kinematics of a model.

Each account says which columns of a log are not what their names say, and gives the trial as it
would be otherwise. Columns are numbered through: states 0 to n - 1, then inputs. What is likelier
without looking at the log has the smaller price: one column before several, too large before too
small, a velocity's sign before its position's, a unit before an exchange.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from grounded.frozen import Array
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial

DEGREES = 180 / np.pi  # in a radian
RPM = 30 / np.pi  # revolutions a minute in one rad/s
# a unit: other units that may stand in its place, and how many of them it has
UNITS: dict[str, dict[str, float]] = {
    "rad": {"deg": DEGREES},
    "deg": {"rad": 1 / DEGREES},
    "rad/s": {"deg/s": DEGREES, "rpm": RPM},
    "deg/s": {"rad/s": 1 / DEGREES},
    "rpm": {"rad/s": 1 / RPM, "1/s": 1 / 60},
    "m": {"mm": 1e3, "cm": 1e2, "km": 1e-3, "feet": 3.28084},
    "m/s": {
        "mm/s": 1e3,
        "cm/s": 1e2,
        "km/h": 3.6,
        "knots": 1.943844,
        "mph": 2.236936,
        "ft/s": 3.28084,
    },
    "%": {"parts of 1": 0.01},
}
FULL = {"percent": 100.0, "counts of 8 bits": 255.0, "thousandths": 1000.0}  # full scale of a part
WORDS = {"deg": "degrees", "deg/s": "degrees a second", "rad": "radians"}
OPENED, OVER = 0.05, 1.03  # share of full scale that the largest command of a log lies between
PREFIXES = ("m", "k", "c", "u", "M")


@dataclass(frozen=True)
class Account:
    """One story of how a log came about.

    Args:
        kind: unit, sign, exchange, dead, offset, axes or pace (of the time stamps).
        columns: those that are changed, or dead.
        factor: how many times too large they are; -1: of the other sign.
        offset: what is added to the first of them after that.
        pairs: columns in each other's place.
        unit: in which the columns are, or "".
        price: what it costs before any log is seen [nats].
        fitted: the heading whose offset is to be estimated.
    """

    kind: str
    columns: tuple[int, ...] = ()
    factor: float = 1.0
    offset: float = 0.0
    pairs: tuple[tuple[int, int], ...] = ()
    unit: str = ""
    price: float = 0.0
    fitted: bool = False

    @property
    def touched(self) -> frozenset[int]:
        """All columns that the account concerns."""
        return frozenset((*self.columns, *(k for pair in self.pairs for k in pair)))

    @property
    def certain(self) -> bool:
        """Whether a trial is corrected: a sign, or the unit of an angle or a rate."""
        turning = self.unit in ("deg", "deg/s", "rpm", "rad") or abs(self.factor) in ANGULAR
        return self.kind == "dead" or self.kind == "sign" or (self.kind == "unit" and turning)

    def mended(self, trial: Trial) -> Trial:
        """Return the trial as it would be without the fault."""
        if self.kind == "pace":
            return replace(trial, dt=trial.dt * self.factor)
        n, steps = len(trial.state_names), len(trial.inputs)
        z, some = versions(trial, [self])[0], list(self.columns)
        if self.kind == "axes":  # speeds (the last two columns) are rotated by the first
            (psi, u, v), turned = self.columns, np.array(z)
            c, s = np.cos(trial.states[:, psi]), np.sin(trial.states[:, psi])
            turned[:, u], turned[:, v] = c * z[:, u] + s * z[:, v], c * z[:, v] - s * z[:, u]
            z = turned
        held = trial.start_inputs
        sent = [k - n for k in some if k >= n]
        if held is not None and sent:
            held = np.array(held)
            held[sent] /= self.factor
        return replace(trial, states=z[:, :n], inputs=z[:steps, n:], start_inputs=held)


def versions(trial: Trial, accounts: Sequence[Account]) -> Array:
    """Return a trial as it would be by each account but for turned axes, (K, T + 1, n + m)."""
    last = trial.inputs[-1:] if trial.steps else np.full((1, len(trial.input_names)), np.nan)
    logged = np.hstack([trial.states, np.vstack([trial.inputs, last])])
    found = np.repeat(logged[None], len(accounts), axis=0)
    for z, account in zip(found, accounts, strict=True):
        for pair in account.pairs:
            z[:, pair] = z[:, pair[::-1]]
        some = list(account.columns)
        z[:, some] = np.nan if account.kind == "dead" else z[:, some] / account.factor
        z[:, some[:1]] += account.offset  # of the heading, which comes first
    return found


@dataclass(frozen=True)
class Told:
    """An account of some trials, and what shows it.

    Args:
        account: the story.
        trials: indices of the trials that it concerns.
        gain: by how much less is unexplained [nats].
        others: accounts that explain the trials as well.
        whole: whether it concerns all trials.
        by_motion: the state that the model predicts best with it, its rms error as logged and
            mended, and how far ahead [s]; None if kinematics show it.
        moved: of a dead velocity: its position, its mean and how far the position moves.
    """

    account: Account
    trials: tuple[int, ...]
    gain: float
    others: tuple[Account, ...] = ()
    whole: bool = True
    by_motion: tuple[int, float, float, float] | None = None
    moved: tuple[int, float, float] | None = None

    @property
    def certain(self) -> bool:
        """Whether trials are corrected, rather than refused."""
        if self.account.kind == "dead":
            return not self.whole
        if self.by_motion:
            return self.account.unit == "deg" or (self.account.kind == "unit" and not self.whole)
        return self.account.certain


ANGULAR = {DEGREES, 1 / DEGREES, RPM}


def units_of(unit: str, most: float = 0.0) -> dict[str, float]:
    """Return in which other units a signal may be, with the factor by which it is then too large.

    Args:
        unit: the model's unit.
        most: the largest size in the log of a command that is a part of 1.
    """
    if unit in UNITS:
        return UNITS[unit]
    if unit == "1":
        full = [(name, f) for name, f in FULL.items() if OPENED * f < most < OVER * f]
        return dict(full[:1])
    base = unit.partition("/")[0]
    if not base or " " in unit or "^" in unit or base[:1] in PREFIXES:
        return {f"thousandths of {unit}": 1e3}
    return {f"m{unit}": 1e3}


def unit_named(units: Iterable[str], factor: float) -> str:
    """Return in which unit signals are that are too large by a factor; "" if it has no name.

    Args:
        units: the model's, of each signal.
        factor: how many times as large as in these.
    """
    names = set[str]()
    for unit in units:
        stem = unit.partition("/")[0]
        known = FULL if unit == "1" else {**units_of(unit), **units_of(stem)}
        names |= {next((name for name, f in known.items() if np.isclose(f, factor)), "")}
    name = min(names, key=len)  # of a length, if its velocity is in the same unit
    alike = len({one.partition("/")[0] for one in names}) == 1
    return WORDS.get(name, name) if alike else ""


def of_rows(
    model: Model, some: frozenset[int], every: frozenset[int], plane: Sequence[int]
) -> Iterator[Account]:
    """Yield the accounts of states that kinematic rows relate.

    Args:
        model: with the units.
        some: the states in rows that disagree.
        every: the states in rows.
        plane: x, y, the heading, its rate if it is one of the states, and the speeds in m/s of a
            plane; empty without.
    """
    units = list(model.states.values())
    fast = {k for k in some if units[k].endswith("/s")}
    for k in sorted(some):
        yield Account("sign", (k,), -1.0, price=0.0 if k in fast else 0.3)
        for unit, f in units_of(units[k]).items():
            yield from _either(Account("unit", (k,), f, unit=unit), model.n)
    for name in dict.fromkeys(units):
        same = tuple(k for k in sorted(every) if units[k] == name)
        if len(same) > 1 and name in ("m", "m/s") and some & {*same}:
            for unit, f in units_of(name).items():
                yield from _either(Account("unit", same, f, unit=unit, price=0.5), model.n)
    for pair in combinations(sorted(some), 2):
        yield Account("exchange", pairs=(pair,), price=1.0)
    for k in sorted(some):
        for j in range(model.n, model.n + model.m):
            yield Account("exchange", pairs=((k, j),), price=1.5)
    if len(plane) >= 3:
        psi, rate, *speeds = plane[2:] if len(plane) > 3 else (plane[2], -1)
        turning = (psi, rate) if rate >= 0 else (psi,)
        yield Account("offset", (psi,), fitted=True, price=0.5)
        yield Account("sign", (psi,), -1.0, price=0.5, fitted=True)  # a compass
        if rate >= 0:
            yield Account("sign", turning, -1.0, price=0.5)
            yield Account("sign", turning, -1.0, price=1.0, fitted=True)
        if len(speeds) == 2:
            yield Account("axes", (psi, *speeds), price=0.5)


def _either(account: Account, states: int = 0) -> Iterator[Account]:
    """Yield a unit's account, and that of the opposite mistake, where powers of ten may be both."""
    yield account
    if account.factor in (1e3, 1e2, DEGREES):
        yield replace(account, factor=1 / account.factor, unit="", price=account.price + 0.5)
    if account.factor == 1e3 and account.columns[0] < states:
        yield replace(account, factor=1e6, unit="", price=account.price + 1.0)
        yield replace(account, factor=1e-6, unit="", price=account.price + 1.5)


def of_motion(model: Model, shown: Sequence[int], trials: Sequence[Trial]) -> Iterator[Account]:
    """Yield the accounts that kinematics may not show: of whole groups, of commands.

    Args:
        model: with the units.
        shown: indices of the states with a sensor.
        trials: whose largest commands suggest the unit of a part of 1.
    """
    n, units, sent = model.n, list(model.states.values()), list(model.inputs.values())
    pairs = [(r.i, r.j) for r in integrals(model) if r.exact and {r.i, r.j} <= {*shown}]
    alone = [(k,) for k in shown if not any(k in pair for pair in pairs)]
    # states in another unit, all of a kind together or one that no other relates
    turning = tuple(k for k in shown if units[k] in ("rad", "rad/s"))
    angles = tuple(k for k in turning if units[k] == "rad")
    also = tuple(n + j for j, unit in enumerate(sent) if unit == "rad")
    lengths = tuple(k for k in shown if units[k].partition("/")[0] == "m")
    single = [(k,) for k in turning if (k,) in alone or units[k] == "rad"]
    for group in dict.fromkeys(g for g in (turning, angles, *single, angles + also) if g):
        yield Account("unit", group, DEGREES, unit="deg", price=0.1 * len(group))
    for group in (one for one in single if units[one[0]] == "rad/s"):
        yield Account("unit", group, RPM, unit="rpm", price=0.1)
    if not any(unit.partition("/")[0] == "m" for unit in sent):
        single = [(k,) for k in lengths if (k,) in alone and units[k] == "m"]
        for group in dict.fromkeys(g for g in (lengths, *single) if g):
            for f in (1e3, 1e2, 1e-2, 1e-3):
                unit = {1e3: "mm", 1e2: "cm", 1e-3: "km"}.get(f, "")
                yield Account("unit", group, f, unit=unit, price=0.5 * (f < 1))
    # inputs in another unit: all that share theirs, or one
    for name in dict.fromkeys(sent):
        same = tuple(n + j for j, unit in enumerate(sent) if unit == name)
        most = max(
            (float(np.abs(t.inputs[:, j - n]).max(initial=0.0)) for t in trials for j in same),
            default=0,
        )
        for group in dict.fromkeys((same, *((j,) for j in same))):
            for unit, f in units_of(name, most).items():
                if name == "%" and most >= OVER:
                    continue
                account = Account("unit", group, f, unit=unit, price=0.3 * (group != same))
                yield from _either(account) if f >= DEGREES and name != "1" else (account,)
    # signs: of a position with its velocity, of a state that no other relates
    for group in sorted((*pairs, *alone)):
        yield Account("sign", group, -1.0, price=0.5)
    # exchanges: of inputs (one perhaps of the other sign), of joints, of two states
    for a, b in combinations(range(n, n + model.m), 2):
        yield Account("exchange", pairs=((a, b),))
        for k in (a, b):
            yield Account("exchange", (k,), -1.0, pairs=((a, b),), price=1.5)
    exact = [r for r in integrals(model) if r.exact and {r.i, r.j} <= {*shown}]
    for p, q in combinations(exact, 2):
        if np.isclose(p.c, q.c):
            yield Account("exchange", pairs=((p.i, q.i), (p.j, q.j)), price=0.5)
    for pair in combinations(shown, 2):
        yield Account("exchange", pairs=(pair,), price=1.0)
