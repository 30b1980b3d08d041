"""Compare the distance travelled with speeds and heading, by one complex factor.

Over stretches of a log the displacement is m = x + iy, the rows of x and y predict w, and
m = k w + c T with a constant drift c (a current): |k| shows a unit, arg k a heading offset. The
same is fitted with the heading reversed (a compass), without heading (speeds that are already in
the axes of x and y) and with the displacement mirrored (x and y exchanged, or one with the opposite
sign). Only one of these leaves a small remainder of m, however large the factor is.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import Finding, put_right, unusable
from grounded.instruments.kinematics.relations import TURNED_AWAY, Turned, lag_of, turned
from grounded.instruments.kinematics.rows import LEAST, STRETCH, Row, per_step
from grounded.model import Model
from grounded.places import integrals
from grounded.result import listed
from grounded.trial import Trial

FITS = 0.25  # share of the displacement below which the remainder counts as explained
BETTER = 3.0  # factor by which the others must be worse
CLOSE = 2.0  # factor within which another explanation is nearly as good
BLOCKS = 16  # their scatter gives the uncertainty
UNITS = {"knots": 1.943844, "mph": 2.236936, "ft/s": 3.28084, "km/h": 3.6}  # per m/s
FEET = UNITS["ft/s"]  # per m
OF_ONE_UNIT, SURELY = 0.015, 3.0  # tolerance of a unit's factor; standard deviations within it
SOUND = 0.1  # deviation of the factor from 1 below which the unit is right
SAME_SIZE = 1.5  # factor within which a heading's rate and the logged one have the same unit
SNAPPED = np.deg2rad(3)  # offsets this near to a multiple of a right angle are rounded to it
TOLD = 0.9  # coherence of a heading with its rate
SAME, OTHER = ((), "same"), ((), "other")  # the model's unit, and one that is not in UNITS


@dataclass(frozen=True)
class Way:
    """How well a displacement is explained, and by which factor.

    Args:
        left: unexplained rms over the rms of the displacement.
        size: measured displacement over the predicted one.
        angle: rotation of the measured displacement against the predicted one [rad].
        std: relative standard deviation of the size.
    """

    left: float
    size: float
    angle: float
    std: float


@dataclass(frozen=True)
class Plane:
    """The rows of two positions that rotate with a heading, all with sensors.

    Args:
        model: with these rows.
        relation: the positions and the heading.
        rows: of both positions.
        speeds: states in m/s that the rows depend on.
        angles: states in rad that they depend on, the heading among them.
        rate: state of the heading's rate; None without a sensor for it.
    """

    model: Model
    relation: Turned
    rows: tuple[Row, ...]
    speeds: tuple[int, ...]
    angles: tuple[int, ...]
    rate: int | None

    def names(self, states: Sequence[int]) -> str:
        """Return the names of some states as text."""
        return listed(self.model.state_names[i] for i in states)

    @property
    def xy(self) -> tuple[int, int]:
        """Indices of both positions."""
        return (self.relation.i, self.relation.j)

    def way(self, trial: Trial, factors: Array | None = None, *, mirrored: bool = False) -> Way:
        """Fit a trial's displacements with its states multiplied by factors (n,)."""
        some = trial if factors is None else replace(trial, states=trial.states * factors)
        return _fitted(per_step(self.model, some, self.rows), self.xy, trial.dt, mirrored)

    def times(self, states: Sequence[int], factor: float) -> Array:
        """Return factors of all states (n,): `factor` for some, 1 for the rest."""
        return np.where(np.isin(np.arange(self.model.n), states), factor, 1.0)


def judge_way(model: Model, trials: list[Trial], rows: Sequence[Row]) -> Iterator[Finding]:
    """Correct compass headings in place; raise an error for other axes or units of speeds.

    Args:
        model: however crude.
        trials: of this model's states; corrected ones are replaced in the list.
        rows: kinematic rows, see `rows.kinematic_rows`.

    Yields:
        A finding for each corrected signal.

    Raises:
        GroundedError: with the rotation to undo, or the scales for [log].
    """
    plane = plane_of(model, rows)
    if plane is not None:
        stop_at_axes(plane, trials)
        yield from turned_compass(plane, trials)
        stop_at_units(plane, trials)


def plane_of(model: Model, rows: Sequence[Row]) -> Plane | None:
    """Return the plane in which a model moves; None if it has none, or no sensors for its rows.

    Args:
        model: any.
        rows: kinematic rows, see `rows.kinematic_rows`.
    """
    relation = turned(model) if rows else None
    if relation is None:
        return None
    both = tuple(row for row in rows if row.i in (relation.i, relation.j))
    units, by = list(model.states.values()), sorted({j for row in both for j in row.by})
    speeds = tuple(j for j in by if units[j] == "m/s")
    lengths = units[relation.i] == units[relation.j] == "m"
    if len(both) < 2 or relation.k not in by or not speeds or not lengths:
        return None
    rates = [row.by[0] for row in rows if row.i == relation.k and len(row.by) == 1]
    angles = tuple(j for j in by if units[j] == "rad")
    return Plane(model, relation, both, speeds, angles, rates[0] if rates else None)


def _fitted(
    steps: Sequence[tuple[Array, Array]], xy: tuple[int, int], dt: float, mirrored: bool
) -> Way:
    """Fit the complex factor, over the stretch length with the smallest remainder."""
    sums = [
        (np.cumsum(x[:, xy[0]] + 1j * x[:, xy[1]]), np.cumsum(w[:, xy[0]] + 1j * w[:, xy[1]]))
        for x, w in steps
    ]
    best, far = Way(1.0, 0.0, 0.0, np.inf), max(1, round(STRETCH / dt))
    while usable := [pair for pair in sums if len(pair[0]) > LEAST * far]:
        m, w = (
            np.concatenate([(d := z[k][far:] - z[k][:-far]) - d.mean() for z in usable])
            for k in (0, 1)
        )
        m = m.conj() if mirrored else m
        moved, said = float((abs(m) ** 2).sum()), float((abs(w) ** 2).sum())
        if moved > 0 and said > 0:
            k = complex((w.conj() * m).sum()) / said
            rest = m - k * w
            left = float(np.sqrt((abs(rest) ** 2).sum() / moved))
            if left < best.left:
                at = np.arange(len(m)) * BLOCKS // len(m)
                pull = ((w.conj() * rest) / k).real
                std = float(np.sqrt((np.bincount(at, pull) ** 2).sum())) / said
                best = Way(left, abs(k), float(np.angle(k)), std)
        far *= 2
    return best


def _concerned(told: Sequence[object], what: object) -> list[int]:
    """Return the trials with this result, or all of them if the others are inconclusive."""
    some = {k for k, one in enumerate(told) if one == what}
    return sorted(some if set(told) - {what, None} else range(len(told)))


def stop_at_axes(plane: Plane, trials: Sequence[Trial]) -> None:
    """Raise an error if speeds are the derivatives of x and y instead of those in body axes.

    Only if the heading agrees with its logged rate: a heading in the wrong unit looks the same.

    Raises:
        GroundedError: with the rotation to undo.
    """
    if len(plane.speeds) < 2 or not rate_agrees(plane.model, plane.relation.k, trials):
        return
    told = [_axes(plane, trial) for trial in trials]
    if "world" not in told:
        return
    speeds, xy = plane.names(plane.speeds), plane.names(plane.xy)
    psi = plane.names((plane.relation.k,))
    said = (
        f"{speeds} are in the axes of {xy}, not in body axes: they are the rates of {xy}, while "
        f"the model rotates them by {psi}"
    )
    mend = (
        f"Rotate {speeds} by -{psi} into body axes, both in the log and in the robot's program, or "
        "write the model with speeds in world axes"
    )
    raise unusable(trials, _concerned(told, "world"), said, mend)


def _axes(plane: Plane, trial: Trial) -> str | None:
    """Return whether a trial's speeds are in "body" or "world" axes; None if inconclusive."""
    plain, world = plane.way(trial), plane.way(trial, plane.times(plane.angles, 0.0))
    other = plane.way(trial, plane.times(plane.angles, -1.0))
    if plain.left < FITS and plain.left * BETTER < world.left:
        return "body"
    clear = world.left < FITS and world.left * BETTER < min(plain.left, other.left)
    return "world" if clear and abs(world.angle) < TURNED_AWAY else None


def rate_agrees(model: Model, heading: int, trials: Sequence[Trial]) -> int:
    """Return the sign with which a heading's derivative matches its logged rate; 0 if it doesn't.

    Args:
        model: with an exact relation between the two, psi' = r.
        heading: index of the state.
        trials: of this model's states; without a sensor of the rate the result is 0.
    """
    for relation in integrals(model):
        if relation.i == heading and relation.exact:
            lag = lag_of(model, relation, trials)
            if lag is not None and lag.coherence > TOLD:
                return lag.sign * (1 / SAME_SIZE < lag.scale < SAME_SIZE)
    return 0


def turned_compass(plane: Plane, trials: list[Trial]) -> Iterator[Finding]:
    """Correct, in the list, a heading that counts clockwise from another axis, as a compass does.

    The logged rate shows whether its sign is reversed as well, or x and y are mirrored.
    """
    told = [_compass(plane, trial) for trial in trials]
    angles = [angle for angle in told if angle is not None and angle]
    if not angles:
        return
    sign = rate_agrees(plane.model, plane.relation.k, trials)
    angle = float(np.angle(np.exp(1j * np.array(angles)).mean()))
    right = np.rint(angle / (np.pi / 2)) * np.pi / 2
    offset = float(right if abs(angle - right) < SNAPPED else angle)
    some = _concerned([None if angle is None else bool(angle) for angle in told], True)
    psi, i = plane.names((plane.relation.k,)), plane.relation.k
    signs, plus = plane.times((i,), -1.0), plane.times((i,), offset) - plane.times((i,), 0.0)
    if sign > 0 and plane.rate is not None:
        if not all(_not_mirrored(plane, trials[k]) for k in some if told[k] is not None):
            return
        signs = signs * plane.times((plane.rate,), -1.0)
    for k in some:
        trials[k] = replace(trials[k], states=trials[k].states * signs + plus)
    whole = len(some) == len(trials)
    where = f" in trial{'s' * (len(some) > 1)} {', '.join(trials[k].id for k in some)}"
    text = (
        f"turns in the opposite direction to the course given by {plane.names(plane.xy)}"
        f"{where * (not whole)}: it is {np.rad2deg(offset):.0f} degrees minus the logged value "
        "(a compass counts clockwise from north)"
    )
    log = f"scale = -1, offset = {offset:.8g}" * whole
    yield put_right(psi, text, "sign", log, scale=-1.0)
    if sign > 0 and plane.rate is not None:
        text, r = "has the opposite sign as well", plane.names((plane.rate,))
        yield put_right(r, text + where * (not whole), "sign", "scale = -1" * whole, scale=-1.0)


def _compass(plane: Plane, trial: Trial) -> float | None:
    """Return the offset [rad] of a reversed heading, 0 if not reversed, None if inconclusive."""
    plain, other = plane.way(trial), plane.way(trial, plane.times(plane.angles, -1.0))
    if plain.left < FITS and plain.left * BETTER < other.left:
        return 0.0
    reflected = plane.way(trial, mirrored=True)
    clear = other.left < FITS and other.left * BETTER < plain.left
    if not clear or reflected.left * BETTER < other.left or abs(other.angle) < TURNED_AWAY:
        return None
    return other.angle


def _not_mirrored(plane: Plane, trial: Trial) -> bool:
    """Check that mirrored positions (exchanged, or one sign reversed) fit a trial much worse."""
    other = plane.way(trial, plane.times(plane.angles, -1.0))
    return plane.way(trial, mirrored=True).left > CLOSE * other.left


def stop_at_units(plane: Plane, trials: Sequence[Trial]) -> None:
    """Raise an error for speeds in knots, km/h, mph or feet per second, and positions in feet.

    Raises:
        GroundedError: with the scales for [log].
    """
    told = [_unit(plane, trial) for trial in trials]
    found = {one for one in told if one is not None and one != SAME}
    if len(found) != 1 or OTHER in found:
        return
    ((states, unit),) = found
    factor = FEET if unit == "feet" else UNITS[unit]
    some = "; ".join(f"[log.state.{plane.names((i,))}] scale = {1 / factor:.6g}" for i in states)
    verb = "looks" if len(states) == 1 else "look"
    said = (
        f"{plane.names(states)} {verb} {factor:.4g} times too large (in {unit}): divided by that, "
        f"positions move as speeds and {plane.names((plane.relation.k,))} imply"
    )
    mend = (
        "Put these scales into [log] (multiply the scale there; a missing one is 1) and into the "
        "robot's program"
    )
    raise unusable(trials, _concerned(told, (states, unit)), f"{said}: {some}", mend, said)


def _unit(plane: Plane, trial: Trial) -> tuple[tuple[int, ...], str] | None:
    """Return the states of a trial in another unit with the unit, SAME, OTHER or None.

    None means that the trial is inconclusive.
    """
    plain = plane.way(trial)
    if plain.left < FITS and abs(plain.size - 1) < SOUND:
        return SAME
    groups = {plane.speeds: UNITS, plane.xy: {"feet": FEET}}
    if len(plane.speeds) > 1:
        groups |= {(i,): UNITS for i in plane.speeds}
    found = {}
    for states, units in groups.items():
        for unit, factor in units.items():
            one = plane.way(trial, plane.times(states, 1 / factor))
            near = max(abs(one.size - 1), SURELY * one.std) < OF_ONE_UNIT
            if near and one.left < FITS:
                found[states, unit] = one.left * (CLOSE if len(states) == 1 else 1.0)
    if not found:
        sure = plain.left < FITS and SURELY * plain.std < OF_ONE_UNIT
        return OTHER if sure else None
    best = min(found, key=lambda one: found[one])
    return (best[0], best[1])
