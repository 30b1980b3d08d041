"""The stories of how a log came about: one table, made from the units and kinematics of a model.

Each account says which columns of a log are not what their names say, and gives the trial as it
would be otherwise. Columns are numbered through: states 0 to n - 1, then inputs. What is likelier
without looking at the log has the smaller price: one column before several, too large before too
small, a velocity's sign before its position's, a unit before an exchange.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Flag, auto
from itertools import combinations, product

import numpy as np

from grounded.accounts.levels import SMALL
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial
from grounded.units import DEGREES, RPM, factor_between

# a unit: other units that may stand in its place, and how many of them it has
UNITS: dict[str, dict[str, float]] = {
    unit: {other: factor_between(unit, other) or 1.0 for other in others}
    for unit, others in {
        "rad": ("deg",),
        "deg": ("rad",),
        "rad/s": ("deg/s", "rpm"),
        "deg/s": ("rad/s",),
        "rpm": ("rad/s",),
        "m": ("mm", "cm", "km", "feet"),
        "m/s": ("mm/s", "cm/s", "km/h", "knots", "mph", "ft/s"),
    }.items()
}
UNITS["rpm"]["1/s"], UNITS["%"] = 1 / 60, {"parts of 1": 0.01}
FULL = {"percent": 100.0, "counts of 8 bits": 255.0, "thousandths": 1000.0}  # full scale of a part
WORDS = {"deg": "degrees", "deg/s": "degrees a second", "rad": "radians"}
OVER = 1.03  # share of full scale that the largest command of a log stays below
PREFIXES = ("m", "k", "c", "u", "M")


class Term(Flag):
    """What can show an account: kinematic rows, the motion given the model, commands."""

    ROWS = auto()
    MOTION = auto()
    COMMANDS = auto()


ROWS, MOTION, COMMANDS = Term.ROWS, Term.MOTION, Term.COMMANDS


@dataclass(frozen=True)
class Account:
    """One story of how a log came about."""

    kind: str  # unit, sign, exchange, dead, offset, axes or pace (of the time stamps)
    columns: tuple[int, ...] = ()  # those that are changed, or dead
    factor: float = 1.0  # how many times too large they are; -1: of the other sign
    offset: float = 0.0  # what is added to the first of them after that
    pairs: tuple[tuple[int, int], ...] = ()  # columns in each other's place
    unit: str = ""  # in which the columns are
    price: float = 0.0  # what it costs before any log is seen [nats]
    fitted: bool = False  # the heading's offset is to be estimated
    terms: Term = field(default=Term(0), compare=False)  # what can show it

    @property
    def touched(self) -> frozenset[int]:
        """All columns that the account concerns."""
        return frozenset((*self.columns, *(k for pair in self.pairs for k in pair)))

    def mended(self, trial: Trial) -> Trial:
        """Return the trial as it would be without the fault."""
        if self.kind == "pace":
            return replace(trial, dt=trial.dt * self.factor)
        n, steps, some = len(trial.state_names), trial.steps, list(self.columns)
        last = trial.inputs[-1:] if steps else np.full((1, len(trial.input_names)), np.nan)
        z = np.hstack([trial.states, np.vstack([trial.inputs, last])])
        for pair in self.pairs:
            z[:, pair] = z[:, pair[::-1]]
        if self.kind == "axes":  # speeds (the last two columns) are rotated by the first
            psi, u, v = some
            back = (z[:, u] + 1j * z[:, v]) * np.exp(-1j * z[:, psi])
            z[:, u], z[:, v] = back.real, back.imag
        z[:, some] = np.nan if self.kind == "dead" else z[:, some] / self.factor
        z[:, some[:1]] += self.offset  # of the heading, which comes first
        held, sent = trial.start_inputs, [k - n for k in some if k >= n]
        if held is not None and sent:
            held = np.array(held)
            held[sent] /= self.factor
        return replace(trial, states=z[:, :n], inputs=z[:steps, n:], start_inputs=held)


@dataclass(frozen=True)
class Told:
    """An account of some trials, and what shows it."""

    account: Account
    trials: tuple[int, ...]  # indices of those that it concerns
    gain: float  # by how much less is unexplained [nats]
    others: tuple[Account, ...] = ()  # that explain the trials as well
    whole: bool = True  # it concerns all trials
    # the state that the model predicts best with it, its rms error as logged and mended, and how
    # far ahead [s]; None if kinematics show it
    by_motion: tuple[int, float, float, float] | None = None
    # of a dead velocity: its position, its mean and how far the position moves
    moved: tuple[int, float, float] | None = None

    @property
    def certain(self) -> bool:
        """Whether trials are corrected, rather than refused.

        A sign is, and the unit of an angle or a rate; of what motion shows, only degrees, or the
        unit of a few trials.
        """
        kind, unit, factor = self.account.kind, self.account.unit, abs(self.account.factor)
        if kind == "dead":
            return not self.whole
        if self.by_motion:
            return unit.startswith("deg") or (kind == "unit" and not self.whole)
        turning = unit in ("deg", "deg/s", "rpm", "rad") or factor in (DEGREES, 1 / DEGREES, RPM)
        return kind == "sign" or (kind == "unit" and turning)


def units_of(unit: str, most: float = 0.0) -> dict[str, float]:
    """Return in which other units a signal may be, with the factor by which it is then too large.

    `most` is the largest size in the log of a command that is a part of 1.
    """
    if unit in UNITS:
        return UNITS[unit]
    if unit == "1":
        full = [(name, f) for name, f in FULL.items() if SMALL * f < most < OVER * f]
        return dict(full[:1])
    base = unit.partition("/")[0]
    if not base or " " in unit or "^" in unit or base[:1] in PREFIXES:
        return {f"thousandths of {unit}": 1e3}
    return {f"m{unit}": 1e3}


def unit_named(units: Iterable[str], factor: float) -> str:
    """Return in which unit signals are that are too large by a factor; "" if it has no name."""
    names = set[str]()
    for unit in units:
        stem = unit.partition("/")[0]
        known = FULL if unit == "1" else {**units_of(unit), **units_of(stem)}
        names |= {next((name for name, f in known.items() if np.isclose(f, factor)), "")}
    name = min(names, key=len)  # of a length, if its velocity is in the same unit
    alike = len({one.partition("/")[0] for one in names}) == 1
    return WORDS.get(name, name) if alike else ""


def accounts(
    model: Model,
    shown: Sequence[int] | None = None,
    related: Collection[int] = (),
    plane: Sequence[int] = (),
    inputs: Sequence[Array] = (),
) -> Iterator[Account]:
    """Yield every story of columns that are not what their names say: the table.

    Args:
        model: with the units.
        shown: indices of the states with a sensor; None: all.
        related: those that kinematic rows relate.
        plane: the heading, its rate (-1 if it is no state), and the speeds in m/s of a plane.
        inputs: commands of logs (T, m), whose largest suggest the unit of a part of 1.
    """
    units, shown = (
        [*model.states.values(), *model.inputs.values()],
        range(model.n) if shown is None else shown,
    )
    sent, related = range(model.n, model.n + model.m), sorted(related)
    exact = [r for r in integrals(model) if r.exact and {r.i, r.j} <= {*shown}]
    pairs = [(one.i, one.j) for one in exact]
    alone = [(k,) for k in shown if not any(k in pair for pair in pairs)]

    def of(some: Iterable[int], *wanted: str) -> tuple[int, ...]:
        return tuple(k for k in some if units[k] in wanted)

    def rows(*some: int) -> Term:
        return ROWS if {*some} <= {*related} else Term(0)

    # units: of one column, of one sensor, of all columns of a kind, of all commands of a unit
    alike = [of(sent, units[k]) for k in sent]
    stems = [(f"{stem}", f"{stem}/s") for stem in ("rad", "deg", "m")]
    kinds = [of(shown, *kind) for both in stems for kind in (both, both[:1], both[1:])]
    angles = of(shown, "rad")
    groups = [*((k,) for k in (*shown, *sent)), *pairs, *kinds, *alike, angles + of(sent, "rad")]
    # lengths scale with commands that are one
    scaled = any(units[k].partition("/")[0] == "m" for k in sent)
    for group in filter(None, dict.fromkeys(groups)):
        fixed = scaled and any(units[k].startswith("m") for k in group)
        fixed |= all(units[k] == "m/s" for k in group)  # which a wrong drag changes as well
        whole = all((i in group) == (j in group) for i, j in pairs)  # a row tells one alone
        motion = MOTION if whole and not fixed else Term(0)
        yield from _units(units, group, rows(*group) | motion | COMMANDS, model.n, inputs)
    for factor in (1e3, 1e-3):  # time stamps in ms, or taken for ms
        yield Account("pace", tuple(range(model.n)), factor, unit="ms", price=1.0, terms=ROWS)
    # signs: of one column, of a position with its velocity, of commands
    for k in shown:
        price = 0.3 * (not units[k].endswith("/s"))
        yield Account("sign", (k,), -1.0, price=price, terms=COMMANDS | rows(k))
    for group in sorted((*pairs, *alone)):
        yield Account("sign", group, -1.0, price=0.5, terms=MOTION | COMMANDS)
    for group in dict.fromkeys((*((k,) for k in sent), *alike)):
        yield Account("sign", group, -1.0, terms=COMMANDS)
    # exchanges: of inputs (one perhaps of the other sign), joints, and any two columns
    for a, b in combinations(sent, 2):
        for turned in ((), (a,), (b,)):
            price = 1.5 * len(turned)
            yield Account("exchange", turned, -1.0, pairs=((a, b),), price=price, terms=MOTION)
    for p, q in combinations(exact, 2):
        if np.isclose(p.c, q.c):
            both = ((p.i, q.i), (p.j, q.j))
            yield Account("exchange", pairs=both, price=0.5, terms=MOTION)
    for pair in combinations(shown, 2):
        yield Account("exchange", pairs=(pair,), price=1.0, terms=MOTION | rows(*pair))
    for k, j in product(related, sent):
        yield Account("exchange", pairs=((k, j),), price=1.5, terms=ROWS)
    if plane:  # headings from another zero, or counted the other way, as by a compass
        psi, rate, *speeds = plane
        yield Account("offset", (psi,), fitted=True, price=0.5, terms=ROWS)
        yield Account("sign", (psi,), -1.0, price=0.5, fitted=True, terms=ROWS)
        if rate >= 0:
            yield Account("sign", (psi, rate), -1.0, price=0.5, terms=ROWS)
            yield Account("sign", (psi, rate), -1.0, price=1.0, fitted=True, terms=ROWS)
        if len(speeds) == 2:
            yield Account("axes", (psi, *speeds), price=0.5, terms=ROWS)


def _units(
    units: Sequence[str], group: tuple[int, ...], terms: Term, n: int, inputs: Sequence[Array]
) -> Iterator[Account]:
    """Yield the units that a group of columns may be in, and the opposite mistakes.

    Motion shows gross ones alone: a model may be wrong by a factor near 1.
    """
    first, name = group[0], units[group[0]]
    each = [np.abs(u[:, k - n]).max(initial=0.0) for u in inputs for k in group if k >= n]
    most = float(max(each, default=0.0))
    alike = first >= n and len(group) == 1 and units[n:].count(name) > 1
    price = 0.3 if alike else 0.02 * (len(group) - 1)
    for unit, f in units_of(name, most).items():
        if name == "%" and most >= OVER:
            continue
        small = 0.5 * (f < 1 and first < n)  # numbers that are too large are noticed less
        shown = terms if max(f, 1 / f) >= RPM else terms & ~Term.MOTION
        account = Account("unit", group, f, unit=unit, price=price + small, terms=shown)
        yield account
        if f in (1e3, 1e2, DEGREES) and name != "1":
            tiny = f == DEGREES and first < n  # no unit has numbers smaller than radians by 57
            by = shown & ~Term.MOTION if tiny else shown
            yield replace(account, factor=1 / f, unit="", price=price + 0.5, terms=by)


def of_commands(model: Model, *inputs: Array) -> list[Account]:
    """Return the units and signs that commands may show: one wheel, or gyro, may be off whole."""
    return [one for one in accounts(model, inputs=inputs) if Term.COMMANDS in one.terms]
