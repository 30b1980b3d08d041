"""Dead velocity sensors: a constant or mere noise while the position moves.

Causes are a wrong column, a gyro that is off, or one of another axis. Taken as a measurement, such
a signal contradicts the motion, and any effect that suppresses the motion would seem to explain it.
A signal counts as noise if it is far smaller than the rate of the position and does not correlate
with it at any delay; a wrong unit or sign would keep the correlation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.frozen import Array, wrapped
from grounded.instruments.kinematics import pieces
from grounded.instruments.other_units import unusable
from grounded.model import Model
from grounded.places import Integral, integrals
from grounded.trial import Trial

LEAST = 20  # fewest samples
MOVED, SHARE = 20.0, 0.1  # least motion: standard deviations of its noise, and share of its range
WINDOWS = 40  # windows of a piece over which displacements are compared
SHAPE = 0.5  # correlation above which two displacements have the same shape
LATE_S = 0.5  # [s] largest sensor delay considered


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
