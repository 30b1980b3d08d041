"""Velocity sensors against their positions: dead, computed from the position, or with a bias.

Dead (`judge_dead`): a constant or mere noise while the position moves. Causes are a wrong column, a
gyro that is off, or one of another axis. Taken as a measurement, such a signal contradicts the
motion, and any effect that suppresses the motion would seem to explain it. A signal counts as noise
if it is far smaller than the rate of the position and does not correlate with it at any delay; a
wrong unit or sign would keep the correlation.

Computed from the position by a causal filter (`derived`). Such a velocity is a weighted sum of past
differences of its position, with weights that sum to 1. The weights, fitted by least squares, give
its age and the time it averages over, whatever the shape of the filter. Such a velocity also
carries the position's noise, exactly. If it is from a sensor of its own, however late or slow,
weights that fit its motion add the position's noise to it, and leave at least that as a remainder.
Two later differences get weights too. The next one may have some, as resampling interpolates
between rows; a filter knows nothing of the one after it. If the log came faster than commands do,
only part of the noise is seen, and many weights are too uncertain: fewer are fitted then.

Biased by a constant (`constant_of`). Over a stretch of T seconds the mean velocity is the distance
over the time, whatever the physics:

    mean of c y_w  -  (y_q(T) - y_q(0)) / T  =  c b + k (y_q(T) - y_q(0)) / T + noise

with a bias b of the velocity's sensor and a scale error k of either sensor. Both are fitted over
stretches of all trials; the scatter about the line gives their uncertainty. The rate of a heading
may differ in proportion to the speed instead: two wheels of unequal size turn a vehicle that their
encoders see going straight. At rest such a difference is none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array, median, white_noise, wrapped
from grounded.instruments.finding import unusable
from grounded.instruments.kinematics.relations import OFF, pieces
from grounded.instruments.lag import SURE, SURELY
from grounded.instruments.single import quantum
from grounded.model import Model
from grounded.places import Integral, heading, integrals, speed
from grounded.trial import Trial

# of a dead sensor
LEAST = 20  # fewest samples
MOVED, SHARE = 20.0, 0.1  # least motion: standard deviations of its noise, and share of its range
WINDOWS = 40  # windows of a piece over which displacements are compared
SHAPE = 0.5  # correlation above which two displacements have the same shape
LATE_S = 0.5  # [s] largest sensor delay considered
# of a derived velocity
PASTS, LATER = (24, 12, 6, 3), 2  # differences before and after the sample that get a weight
ENOUGH = 10  # samples per weight
FORESEEN = 0.1  # weight of the second later difference above which it is no causal filter
CARRIED = 0.75  # of the noise that the weights take from the position: more is another's
UNEXPLAINED = 0.2  # of the velocity's size: a larger remainder comes from another sensor
# of a bias
STRETCHES = 24  # least number of stretches over all trials
SHORTEST = 4  # steps in the shortest stretch
NONE = 3.0  # standard deviations below which it may be zero
BETTER = 0.5  # share of the squares that a constant leaves, below which the speed explains more
LARGE = 0.01  # of the velocity's rms: the smallest bias reported
FINE = 0.02  # of the velocity's rms: SURE standard deviations must be below it to rule a bias out


@dataclass(frozen=True)
class Dead:
    """A velocity (state j of the relation) that does not show the motion of its position (state i).

    Args:
        relation: between position and velocity.
        value: the velocity's constant value, or its mean.
        moved: how far the position moves beyond what that value says, in its unit.
        noise: standard deviation about `value`, of a velocity that shows only noise; else 0.
    """

    relation: Integral
    value: float
    moved: float
    noise: float = 0.0

    def told(self, model: Model, where: str = "") -> str:
        """Return a clause that continues a sentence after the velocity's name."""
        i, j = self.relation.i, self.relation.j
        (q, of_q), unit = list(model.states.items())[i], list(model.states.values())[j]
        while_ = f"while {q} moves by {self.moved:.3g} {of_q}"
        if self.noise:
            return (
                f"shows only noise of {self.noise:.2g} {unit} around {self.value:.4g}{where},"
                f" {while_}"
            )
        return f"stays at {self.value:.4g} {unit}{where}, {while_}"


def dead_rates(
    model: Model, trial: Trial, relations: Sequence[Integral] | None = None
) -> list[Dead]:
    """Return the velocities of a trial whose sensors are dead.

    Args:
        model: however crude; used only for which state is the rate of which.
        trial: with this model's states.
        relations: `integrals(model)`, if already computed.
    """
    found = []
    for relation in integrals(model) if relations is None else relations:
        rate = trial.states[:, relation.j]
        known = rate[np.isfinite(rate)]
        if len(known) < LEAST:
            continue
        if np.ptp(known) > 0:
            found += _noise_alone(model, trial, relation)
            continue
        value, moved, noise, own, way = float(known[0]), 0.0, 0.0, 0.0, 0.0
        for piece in pieces([trial], [relation.i, relation.j]):
            said = relation.c * value * trial.dt * np.arange(len(piece))
            moved = max(moved, float(np.ptp(piece[:, 0] - said)))
            own, way = max(own, float(np.ptp(piece[:, 0]))), max(way, float(np.ptp(said)))
            noise = max(noise, _noise(piece[:, 0]))
        if min(moved, own) > max(MOVED * noise, SHARE * way, SHARE * own):
            found.append(Dead(relation, value, moved))
    return found


def _noise(position: Array) -> float:
    """Return the standard deviation of a position's white noise, from its second differences."""
    return float(np.std(np.diff(position, n=2)) / np.sqrt(6))


def _noise_alone(model: Model, trial: Trial, relation: Integral) -> list[Dead]:
    """Return the velocity if it has neither the size nor the shape of its position's motion."""
    if not relation.exact:
        return []
    angle, told = [model.angle_mask[relation.i]], []
    turns = list(model.states.values())[relation.i] == "rad"
    for piece in pieces([trial], [relation.i, relation.j]):
        k = len(piece) // WINDOWS
        if k < 1:
            continue
        said = np.concatenate([[0.0], np.cumsum(relation.c * piece[:-1, 1] * trial.dt)])
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, angle)
        if turns and np.abs(moved).max() > np.pi / 2:
            return []  # degrees, or too few samples per turn to unwrap the angle
        way = np.concatenate([[0.0], np.cumsum(moved[:, 0])])
        a, b = (s[k:] - s[:-k] for s in (way, said))
        noise = _noise(way)
        hidden = np.std(b) > SHARE * np.std(a) or np.ptp(way) < MOVED * noise
        if hidden or np.std(a) < 3 * noise or _alike(a, b, round(LATE_S / trial.dt)) > SHAPE:
            return []
        told.append((float(np.mean(piece[:, 1])), float(np.ptp(way)), float(np.std(piece[:, 1]))))
    return [Dead(relation, *max(told, key=lambda one: one[1]))] if told else []


def _alike(a: Array, b: Array, most: int) -> float:
    """Return the largest correlation of two signals, either delayed by up to `most` samples."""
    best = 0.0
    for late in range(-min(most, len(a) // 2), min(most, len(a) // 2) + 1):
        x, y = (a[late:], b[: len(b) - late]) if late >= 0 else (a[:late], b[-late:])
        spread = float(np.std(x) * np.std(y))
        if spread > 0:
            best = max(best, abs(float(np.mean((x - x.mean()) * (y - y.mean())))) / spread)
    return best


def judge_dead(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> list[tuple[int, Dead]]:
    """Return the dead velocity sensors, each with the index of its trial.

    Raises:
        GroundedError: for a velocity whose sensor is dead in every trial.
    """
    relations = [r for r in integrals(model) if {r.i, r.j} <= set(shown)]
    found = [(k, one) for k, t in enumerate(trials) for one in dead_rates(model, t, relations)]
    for j in {one.relation.j for _, one in found}:
        of_it = [(k, one) for k, one in found if one.relation.j == j]
        if len(of_it) == len(trials):
            name = model.state_names[j]
            mend = (
                f"Check the path in [log.state.{name}], or delete that table and estimate "
                f"{name} ([estimate])"
            )
            noisy = any(one.noise for _, one in of_it)
            why = "it is another signal, or its sensor is off" if noisy else ""
            clause = f"{name} {of_it[0][1].told(model)}: {why or 'its sensor shows no motion'}"
            raise unusable(trials, [k for k, _ in of_it], clause, mend)
    return found


@dataclass(frozen=True)
class Derived:
    """The weights of past differences of a position in a velocity, summarised.

    Args:
        gain: their sum.
        gain_std: its standard deviation.
        age: their mean age [s].
        over: length of the plain mean with the same variance of ages [s].
    """

    gain: float
    gain_std: float
    age: float
    over: float


def derived(
    model: Model, relation: Integral, trials: Sequence[Trial], least: float
) -> Derived | None:
    """Return how a velocity follows from its position through a causal filter.

    Args:
        model: with this relation.
        relation: the position and the velocity.
        trials: of this model's states.
        least: time over which it must certainly average [s].

    Returns:
        None if it has another scale, is not explained by the position's past, or averages less.
    """
    dt, columns = trials[0].dt, (relation.i, relation.j)
    counts = quantum([piece[:, 0] for piece in pieces(trials, columns)])
    logs = list[tuple[Array, Array, Array]]()  # rates, velocities and the position's noise
    for piece in pieces(trials, columns):
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        way = np.concatenate([[0.0], np.cumsum(moved)])
        logs.append((moved[:, 0] / dt, relation.c * piece[:, 1], white_noise(way[:, None])))
    floor = counts / np.sqrt(12)  # of an encoder, at rest on one count mostly
    tried = (_weighed(logs, dt, least, past, floor) for past in PASTS)
    return next((found for found in tried if found is not None), None)


def _weighed(
    logs: Sequence[tuple[Array, Array, Array]], dt: float, least: float, past: int, floor: float
) -> Derived | None:
    """Return the same from the weights of `past` differences; `floor`: least noise of a log."""
    rows, said, seen = list[Array](), list[Array](), list[Array]()
    for rate, velocity, own in logs:
        if len(rate) >= past + LATER:
            windows = np.lib.stride_tricks.sliding_window_view(rate, past + LATER)
            rows.append(windows[:, ::-1])
            said.append(velocity[past : past + len(windows)])
            seen.append(own)
    count = sum(map(len, said))
    if count < ENOUGH * (past + LATER):
        return None
    a, w = np.concatenate(rows), np.concatenate(said)
    weights, _, rank, _ = np.linalg.lstsq(a, w, rcond=None)
    rest = w - a @ weights
    size = float(w @ w)
    if rank < a.shape[1] or not float(rest @ rest) < UNEXPLAINED**2 * size:
        return None
    noise = max(float(median(np.concatenate(seen))), floor)
    passed = noise * float(np.linalg.norm(np.diff(np.pad(weights, 1)))) / dt
    if not np.sqrt(rest @ rest / count) < CARRIED * passed:
        return None
    covariance = np.linalg.inv(a.T @ a) * float(rest @ rest) / count
    gain = float(weights.sum())
    if abs(gain - 1) > OFF or abs(float(weights[0])) > FORESEEN:
        return None
    ages = (np.arange(past + LATER) - LATER + 0.5) * dt
    age = float(weights @ ages) / gain
    apart = (ages - age) ** 2 + dt**2 / 12  # each difference is itself a mean over a step
    wide = 12 * float(weights @ apart)
    std = 12 * float(np.sqrt(apart @ covariance @ apart))
    if wide - SURELY * std < least**2:
        return None
    return Derived(gain, float(np.sqrt(covariance.sum())), age, float(np.sqrt(wide)))


@dataclass(frozen=True)
class Constant:
    """The bias of a logged velocity against the rate of its position.

    Args:
        value: the bias, in the velocity's unit; positive if the velocity is too large.
        std: its standard deviation.
        rms: rms of the velocity itself.
        pull: the difference per unit of the speed, if that explains it better; 0 if not.
    """

    value: float
    std: float
    rms: float
    pull: float = 0.0

    @property
    def found(self) -> bool:
        """Whether the bias is significant and large enough to report."""
        return abs(self.value) > max(SURE * self.std, LARGE * self.rms)

    @property
    def refuted(self) -> bool:
        """Whether the trials rule a bias out: none is seen, and one would have been."""
        return abs(self.value) < NONE * self.std and SURE * self.std < FINE * self.rms


def constant_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Constant | None:
    """Return the bias of a logged velocity against its position; None with too little data."""
    rows, whole = _stretches(model, relation, trials)
    if len(rows) < STRETCHES // 2:
        return None
    off, rates, counts = np.array(rows).T[:3]
    fitted, left, inverse = _line(off, [np.ones_like(rates), rates], counts)
    variance = left / (len(rows) - 2) * float(inverse[0, 0])
    rms = float(np.sqrt(np.mean(np.concatenate([piece[:, 1] for piece in whole]) ** 2)))
    std = variance**0.5 / abs(relation.c)
    found = Constant(float(fitted[0]) / relation.c, std, rms)
    driven = speed(model)
    if not found.found or model.state_names[relation.i] != heading(model) or driven is None:
        return found
    also, _ = _stretches(model, relation, trials, model.state_names.index(driven))
    if len(also) < len(rows):
        return found
    off, rates, counts, speeds = np.array(also).T
    along, less, _ = _line(off, [speeds, rates], counts)
    return replace(found, pull=float(along[0]) / relation.c if less < BETTER * left else 0.0)


def _line(off: Array, columns: Sequence[Array], counts: Array) -> tuple[Array, float, Array]:
    """Return a weighted fit of the columns, the sum of squares that it leaves, and its inverse."""
    design = np.stack(columns, axis=1)
    square = design.T @ (counts[:, None] * design)
    inverse = np.asarray(np.linalg.pinv(square, hermitian=True), np.float64)
    fitted = inverse @ (design.T @ (counts * off))
    return fitted, float(counts @ (off - design @ fitted) ** 2), inverse


def _stretches(
    model: Model, relation: Integral, trials: Sequence[Trial], beside: int | None = None
) -> tuple[list[tuple[float, ...]], list[Array]]:
    """Return the difference, the position's rate and the steps of each stretch, and all pieces.

    Args:
        model: with the angles among the states.
        relation: the position and its velocity.
        trials: of one time step.
        beside: another state, whose mean over each stretch is appended.
    """
    columns = (relation.i, relation.j, *(() if beside is None else (beside,)))
    dt, whole = trials[0].dt, list(pieces(trials, columns))
    steps = sum(len(piece) - 1 for piece in whole)
    rows: list[tuple[float, ...]] = []
    for piece in whole:
        moved = np.diff(piece[:, 0])[:, None]
        wrapped(moved, [model.angle_mask[relation.i]])
        rate, w = moved[:, 0] / dt, relation.c * 0.5 * (piece[1:, 1] + piece[:-1, 1])
        parts = max(1, min(-(-STRETCHES * len(rate) // steps), len(rate) // SHORTEST))
        for some in np.array_split(np.arange(len(rate)), parts):
            row = float((w - rate)[some].mean()), float(rate[some].mean()), float(len(some))
            rows.append((*row, *piece[:-1, 2:][some].mean(axis=0)))
    return rows, whole
