"""One assignment: which number of a log is which state or input of a model.

Every number has points for every role, the sum of named evidence:

    name        the words in its path, common names of such quantities     (`names`)
    unit        stated by the log, or by the ROS message type              (`stated_units`)
    kind        a command for an input, what is measured for a state; a number that changes
    joint       the names and the order of joints                          (`joint_names`)
    derivative  where the model has dq/dt = w, w follows q in the samples  (`relations`)

`linear_sum_assignment` takes the assignment of most points, so that no guess overwrites another.
What leads its rivals by `SURE_LEAD` and rests on more than one unit or an order is sure; the rest
is listed. A role that no name fits gets a number only if as many fit as there are such roles.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from grounded.findings import Finding, found
from grounded.model import Model
from grounded.places import rate_states
from grounded.units import DEGREES, factor_between
from grounded_trials.logs.inspection import names as words
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.inspect_log import FieldReport, LogReport, TopicReport
from grounded_trials.logs.inspection.joint_names import (
    NAMED,
    Joint,
    Joints,
    in_order,
    joint_names,
    joint_units,
    of_joint,
)
from grounded_trials.logs.inspection.relations import (
    COMBINATIONS,
    FOLLOWS,
    SAME,
    SURELY,
    Follows,
    Signals,
    follows,
)
from grounded_trials.logs.stated_units import LENGTHS, is_angle, unit_of, without_role

POINTS_TO_PROPOSE = 2.0  # points from which a number is proposed whatever else there is
SURE_LEAD = 1.5  # lead over the next number, to be sure
LEAD = 0.75  # lead of a number without a name over those that fit worse
MOST_CANDIDATES = 20  # largest number of candidates
UNNAMED = 60  # most numbers without a name that are tried as rates
LATEST = 0.5  # [s] a command is sought up to this long before the angle that follows it
STATED, CAP = 1.8, 5.0  # points of a unit that the log states; most of a relation


@dataclass(frozen=True)
class _Number:
    path: str
    topic: TopicReport
    field: FieldReport
    said: str  # the unit that the log states
    known: str  # the unit by convention
    command: bool  # on a topic of commands

    @property
    def moves(self) -> bool:
        return self.field.low != self.field.high

    @property
    def measured(self) -> bool:
        """Whether it is a joint's position or speed, a pose or odometry: no command."""
        kind = self.topic.type
        joint = kind.endswith("/JointState") and ".effort[" not in self.path
        away = not self.command and (joint or kind.endswith(words.POSES))
        return away or kind.endswith(words.MEASURED)


def assigned(
    log: LogReport,
    states: Mapping[str, str],
    inputs: Mapping[str, str],
    model: Model | None = None,
    given: Mapping[str, str] = MappingProxyType({}),
) -> tuple[tuple[Guess, ...], tuple[Guess, ...]]:
    """Return guesses for the states and for the inputs, in their order.

    Args:
        log: an inspected log.
        states: units of the states by name, "" where unknown.
        inputs: units of the inputs by name.
        model: whose equations relate them; None: names and units alone decide.
        given: numbers after which some states and inputs are named.
    """
    table = _Table(log, states, inputs, model)
    for name, path in ((n, p) for n, p in given.items() if n in table.row):
        table.add(name, path, 2 * CAP)
        table.named.add((name, path))
    table.look()
    guesses = table.solved(named=bool(given))
    for pair in table.rates.items():
        guesses |= _followed(guesses, pair, table)
    done = [table.finished(guess) for guess in guesses.values()]
    return tuple(done[: len(states)]), tuple(done[len(states) :])


class _Table:
    """The points of every number for every role, and why."""

    def __init__(
        self,
        log: LogReport,
        states: Mapping[str, str],
        inputs: Mapping[str, str],
        model: Model | None,
    ) -> None:
        self.log, self.model, self.inputs = log, model, inputs
        self.units = {**states, **inputs}
        rates = rate_states(model) if model is not None else {}
        self.rates = {q: w for q, w in rates.items() if {q, w} <= {*self.units}}
        joints = joint_names(log)
        conventions = joint_units(joints)
        self.numbers = [
            _Number(
                one.path,
                topic,
                one,
                log.unit(one.path),
                conventions.get(one.path, unit_of(one.path)),
                bool(words.COMMAND_TOPIC.search(topic.topic.lower())),
            )
            for topic in log.topics
            for one in topic.fields
            if not words.PARTS.search(one.path)
        ]
        turn = ("", "rad", "deg")
        self.signals = Signals(
            log, {n.path for n in self.numbers if n.known == "rad" or n.said in turn}
        )
        self.at = {number.path: k for k, number in enumerate(self.numbers)}
        self.row = {role: r for r, role in enumerate(self.units)}
        self.points = np.zeros((len(self.row), len(self.numbers)))
        self.why: dict[tuple[str, str], list[Finding]] = {}
        self.named, self.doubted = set[tuple[str, str]](), set[tuple[str, str]]()
        for role, unit in self.units.items():
            called = words.meanings(role, unit * (role in inputs), self.at, [*states])
            for number in self.numbers:
                self._by_itself(role, number, called)
        self._by_joints(joints)

    def add(self, name: str, path: str, points: float, *why: Finding) -> None:
        """Add evidence for a number in a role."""
        if path in self.at:
            self.points[self.row[name], self.at[path]] += points
            self.why.setdefault((name, path), []).extend(why)

    def _by_itself(self, role: str, number: _Number, called: Sequence[str]) -> None:
        """Count what a number's name, unit and kind say; a name says less if it never changes."""
        sent, unit, one = role in self.inputs, self.units[role], number.field
        if sent and number.measured:
            self.add(role, number.path, -2 * CAP)
            return
        points = words.name_points(called, role, number.topic, one, is_input=sent)
        if points:
            self.named.add((role, number.path))
        elif not number.moves or one.low is None:
            return
        points -= 1.0 * (not number.moves)
        points += 1.0 * (sent and number.command and number.moves)
        theirs = number.said or number.known
        fits = factor_between(theirs, unit) is not None
        why: list[Finding] = []
        if unit in ("", "1"):
            points += STATED * bool(number.said and unit and fits)
        elif theirs:
            why = [found("start.unit", role, unit=theirs, model=None if fits else unit)]
            other = -1.5 if number.said or sent else -CAP  # of another sensor
            points += (STATED if number.said else 0.5) if fits else other
        self.add(role, number.path, points, *why)

    def _by_joints(self, joints: Joints) -> None:
        """Count the names of joints, and their order where no name says more."""
        bare, evidence = {}, dict[str, Mapping[str, Joint]]()
        for role, unit in self.units.items():
            sent = role in self.inputs
            evidence[role] = of_joint(role, unit, joints, self.log, sent=sent)
            best = self.points[self.row[role]].max(initial=0.0)
            if not evidence[role] and best < POINTS_TO_PROPOSE:
                bare[role] = unit, sent
        for role, own in (evidence | in_order(bare, joints, self.log)).items():
            for path, one in own.items():
                self.add(role, path, one.points, one.why)
                if one.doubted:
                    self.doubted.add((role, path))
                if one.points >= NAMED - SURE_LEAD:
                    self.named.add((role, path))

    def factor(self, name: str, path: str) -> float:
        """Return the factor from the unit that the log states for a number to a role's."""
        return self.log.factor(path, self.units[name])

    def taken(self) -> dict[str, str]:
        """Return the number of each role, as far as one has enough points: {name: path}."""
        from scipy.optimize import linear_sum_assignment

        roles, numbers = self.points.shape
        gain = np.where(self.points >= POINTS_TO_PROPOSE, self.points, -1e6)
        rows, columns = linear_sum_assignment(
            np.hstack([gain, np.zeros((roles, roles))]), maximize=True
        )
        names, pairs = [*self.row], zip(rows, columns, strict=True)
        return {names[r]: self.numbers[k].path for r, k in pairs if k < numbers}

    def look(self) -> None:
        """Count what the samples say of rates, of speeds and of angles' commands."""
        if self.model is None or not self.numbers:
            return
        first = self.taken()
        for role in self.inputs:
            angle, path = first.get(without_role(role), ""), first.get(role, "")
            if angle and path.endswith("@rpy." + path.rpartition(".")[2]) and angle != path:
                like = self.signals.lagged(path, angle, LATEST)
                if like is not None and like < FOLLOWS:
                    self.add(role, path, -2 * CAP)
        for pair in self.rates.items():
            self._relate(pair, first)
        self._speed(self.model)

    def _relate(self, pair: tuple[str, str], first: Mapping[str, str]) -> None:
        """Count how well candidates for a rate follow those for its position."""
        q, w = pair
        taken = {path for name, path in first.items() if name not in pair}
        free = [n for n in self.numbers if n.moves and n.path not in taken]

        # What a name fits, else what is free, if that is little.
        own = {name: self._near(name) for name in pair}
        bare = [name for name in pair if not own[name]]
        if len(free) <= UNNAMED:
            own |= {name: self._possible(name, free) for name in bare}
        self.signals.read([*own[q], *own[w]])

        # Each gains what the best pair that it is in explains.
        gains = dict[tuple[str, str], float]()
        for a, b in ((a, b) for a in own[q] for b in own[w] if a != b):
            like, stated = self.signals.follows(a, b), (self.log.unit(a), self.log.unit(b))
            if abs(like.correlation) < FOLLOWS:
                continue
            if not first and len(bare) == 2 and like.tenfold is None:
                continue
            by = self.factor(q, a), self.factor(w, b)
            fits = any(True for _ in _readings(like.slope * by[1] / by[0], stated, by))
            points = _capped(like) - 1.5 * (not fits) - 0.5 * (like.correlation < 0)
            for one_of in ((q, a), (w, b)):
                gains[one_of] = max(gains.get(one_of, 0.0), points)
        for (name, path), points in gains.items():
            self.add(name, path, points)

    def _near(self, name: str) -> list[str]:
        """Return the numbers that rival for a role, best first."""
        row = self.points[self.row[name]]
        order = [k for k in np.argsort(-row, kind="stable") if row[k] >= POINTS_TO_PROPOSE]
        return [self.numbers[k].path for k in order if row[k] > row[order[0]] - SURE_LEAD]

    def _possible(self, name: str, free: Iterable[_Number]) -> list[str]:
        """Return the numbers without a name whose unit is possible for a role."""
        unit = self.units[name]
        return [
            n.path
            for n in free
            if not (unit in LENGTHS and is_angle(n.path))
            and ("" in (unit, n.said or n.known) or factor_between(n.said or n.known, unit))
        ]

    def _speed(self, model: Model) -> None:
        """Count how an unnamed number follows the speed of the position."""
        name, position = str(model.roles.get("speed", "")), model.roles.get("position", ())
        first = self.taken()
        if name not in self.row or name in first or not {*position} <= {*first} or not position:
            return
        axes = [first[axis] for axis in position]
        bare = [n.path for n in self.numbers if n.moves and n.path not in {*first.values()}]
        bare = [p for p in bare if p.partition("[")[0].endswith(".data")][:COMBINATIONS]
        self.signals.read([*axes, *bare])
        for path in bare:
            if (gridded := self.signals.grid((*axes, path))) is None:
                continue
            step, (*places, speed) = gridded
            by = [self.factor(n, p) for n, p in zip(position, axes, strict=True)]
            moved = [f * np.diff(p) for f, p in zip(by, places, strict=True)]
            way = np.concatenate([[0.0], np.cumsum(np.sqrt(sum(m**2 for m in moved)))])
            like = follows(way, speed * self.factor(name, path), step)
            if like.correlation > FOLLOWS:
                facts: dict[str, Any] = {"correlation": like.correlation, "slope": like.slope}
                why = found("start.follows", name, of=tuple(position), speed=True, **facts)
                self.add(name, path, POINTS_TO_PROPOSE + _capped(like), why)
                self.doubted.add((name, path))

    def solved(self, *, named: bool) -> dict[str, Guess]:
        """Return the assignment of most points by name; other roles have what may fit.

        If roles are `named` after numbers, none is left for another.
        """
        taken = self.taken()
        sent = {path for name, path in taken.items() if name in self.inputs}
        left = [n for n in self.numbers if n.moves and n.path not in {*taken.values()}]
        lost = [role for role in self.row if role not in taken]
        tops = {role: self._best_fitting(role, left) for role in lost}
        last = not named and len(lost) == len(left) == 1 and not any(tops.values())
        tops |= {lost[0]: [left[0].path]} if last else {}
        made = dict[str, Guess]()
        for name in self.row:
            path, top = taken.get(name, ""), tops.get(name, [])
            others = {path for other, some in tops.items() if other != name for path in some}
            if path:
                away = {*taken.values()} - sent if name in self.inputs else sent
                near = tuple(p for p in self._near(name) if p != path and p not in away)
                sure = not near and (name, path) in self.named - self.doubted
                made[name] = Guess(name, path, "", sure, near, None, self._why(name, path))
            elif len(top) == 1 and top[0] not in others:  # the only one left that fits
                number = self.numbers[self.at[top[0]]]
                clear = number.command and self.points[self.row[name], self.at[top[0]]] >= SURE_LEAD
                sure = clear or (len(lost) == len(left) == 1 and not last)
                why = found("start.left", name, numbers=tuple(top), only=not last or None)
                reasons = (*self._why(name, top[0]), why)
                made[name] = Guess(name, top[0], "", sure, (), None, reasons)
            else:
                made[name] = self._offered(name, left)
        return made

    def _why(self, name: str, path: str) -> tuple[Finding, ...]:
        return tuple(self.why.get((name, path), ()))

    def _best_fitting(self, role: str, left: Sequence[_Number]) -> list[str]:
        """Return the numbers that fit a role about as well as the best one."""
        row = self.points[self.row[role]]
        fits = {n.path: row[self.at[n.path]] for n in left if row[self.at[n.path]] >= 1.0}
        return [path for path in fits if fits[path] > max(fits.values()) - LEAD]

    def _offered(self, role: str, left: Sequence[_Number]) -> Guess:
        """Return a role without a number: the commands, what has points, or what is possible."""
        row, possible = self.points[self.row[role]], {*self._possible(role, left)}
        sent = role in self.inputs
        may = [n for n in left if not (sent and n.measured)]
        some = [n for n in may if sent and n.command]
        some = some or [n for n in may if row[self.at[n.path]] > 0]
        some = some or [n for n in may if n.path in possible and not n.said]
        some.sort(key=lambda n: -float(row[self.at[n.path]]))
        empty = [t.topic for t in self.log.topics if not t.messages]
        empty = [topic for topic in empty if words.COMMAND_TOPIC.search(topic.lower())]
        why = (found("start.still", *empty, empty=True),) if empty and sent else ()
        others = tuple(n.path for n in some)[:MOST_CANDIDATES]
        return Guess(role, "", "", False, others, None, why)

    def finished(self, guess: Guess) -> Guess:
        """Return a guess with its clock, its range, and the unit that the log states."""
        path = guess.path or next(iter(guess.others), "")
        if path not in self.at:
            return replace(guess, clock="log")
        number, factor = self.numbers[self.at[path]], self.factor(guess.name, path)
        guess = replace(guess, clock=self.log.clock(number.topic))
        if not guess.path:
            return replace(guess, scale=factor)
        guess = replace(guess, field=number.field, others=guess.others[:3])
        return replace(guess, scale=guess.scale * factor) if abs(factor - 1) > 1e-9 else guess


def _capped(like: Follows) -> float:
    """Return the points of a relation: beyond CAP more of them only break ties."""
    return min(like.points, CAP) + 0.01 * like.points


# What a position and its rate are read as: factors of the two, without the sign, the one of them
# whose unit is not the expected one, if any, and that unit.
_Reading = tuple[float, float, int | None, str]
SAME_UNIT = "the same"


def _readings(slope: float, stated: Sequence[str], by: Sequence[float]) -> Iterator[_Reading]:
    """Yield the readings of a position and its rate that agree in size, most plausible first.

    `slope` is how many times as large the rate is as the derivative, in the model's units; `stated`
    are the units that the log states for the two, "" for none, and `by` the factors from these.
    """
    tried: list[_Reading] = [
        (1.0, 1.0, None, ""),
        (1 / DEGREES, 1.0, 0, "deg"),
        (1.0, 1 / DEGREES, 1, "deg"),
    ]
    if bool(stated[0]) != bool(stated[1]):  # the one unit is that of both
        tried.append((1.0, by[0], 1, SAME_UNIT) if stated[0] else (by[1], 1.0, 0, SAME_UNIT))
    return (one for one in tried if abs(abs(slope) * one[1] / one[0] - 1) < SAME)


def _followed(
    guesses: Mapping[str, Guess], pair: tuple[str, str], table: _Table
) -> dict[str, Guess]:
    """Return a position and its rate with what their samples say of signs and units."""
    q, w = (guesses[name] for name in pair)
    if not (q.path and w.path):
        return {}
    like = table.signals.follows(q.path, w.path)
    by = table.factor(q.name, q.path), table.factor(w.name, w.path)
    slope, size = like.slope * by[1] / by[0], like.correlation
    if abs(size) < FOLLOWS:
        why = found("start.follows", w.name, of=q.path, correlation=size, no=True)
        return {w.name: w.because(why, sure=False)} if size else {}

    # In which units do they agree?
    stated = [table.log.unit(one.path) for one in (q, w)]
    reading = next(_readings(slope, stated, by), None)
    if reading is None:
        w = w.because(found("start.follows", w.name, of=q.path, slope=slope), sure=False)
    else:
        q_by, w_by, odd, unit = reading
        if odd is not None:
            about = pair if unit == SAME_UNIT else (pair[odd],)
            why = found("start.unit", *about, unit=unit, size=True)
            q, w = (g.because(why) if i == odd else g for i, g in enumerate((q, w)))
        q = replace(q, scale=q_by, sure=q.sure and q_by == 1)
        w = replace(w, scale=w_by * float(np.sign(slope)))

        # Each is as sure as the other if nothing else rivals with it.
        alone = [not g.others and (g.name, g.path) not in table.doubted for g in (q, w)]
        kind = stated[0] or table.numbers[table.at[q.path]].known in LENGTHS
        same = min(abs(slope - 1), abs(like.slope - 1)) < SAME
        sure = (kind and size > SURELY and same) or (w.sure and w.scale == 1)
        q = replace(q, sure=q.sure or bool(alone[0] and sure and q.scale == 1))
        w = replace(w, sure=w.sure or (q.sure and alone[1]))
    why = found("start.follows", w.name, of=q.path, correlation=size, opposite=slope < 0)
    return {q.name: q, w.name: w.because(why, sure=w.sure and size > 0)}
