"""A velocity whose sensor shows nothing: one value throughout, while its position moves otherwise.

The wrong column, a gyro that was not switched on: taken for a measurement, it makes the robot turn
without turning, and any effect that holds it still explains it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.instruments.kinematics import Integral, integrals, pieces
from grounded.instruments.other_units import unusable
from grounded.model import Model
from grounded.trial import Trial

LEAST = 20  # samples that are one value
MOVED, SHARE = 20.0, 0.1  # standard deviations of the position's noise, and of all that it moves


@dataclass(frozen=True)
class Dead:
    """State j stays at a value while state i moves by so much more than it says."""

    relation: Integral
    value: float
    moved: float

    def told(self, model: Model, where: str = "") -> str:
        """One clause, after the velocity's name."""
        i, j = self.relation.i, self.relation.j
        (q, of_q), unit = list(model.states.items())[i], list(model.states.values())[j]
        return (
            f"stays at {self.value:.4g} {unit}{where}, while {q} moves by {self.moved:.3g} {of_q}"
        )


def dead_rates(
    model: Model, trial: Trial, relations: Sequence[Integral] | None = None
) -> list[Dead]:
    """The velocities of a trial whose sensors show nothing.

    Args:
        model: however crude: only which state is another's rate is read off it.
        trial: with this model's states.
        relations: of the model, where they are known.
    """
    found = []
    for relation in integrals(model) if relations is None else relations:
        rate = trial.states[:, relation.j]
        known = rate[np.isfinite(rate)]
        if len(known) < LEAST or np.ptp(known) > 0:
            continue
        value, moved, noise, own, way = float(known[0]), 0.0, 0.0, 0.0, 0.0
        for piece in pieces([trial], [relation.i, relation.j]):
            said = relation.c * value * trial.dt * np.arange(len(piece))
            moved = max(moved, float(np.ptp(piece[:, 0] - said)))
            own, way = max(own, float(np.ptp(piece[:, 0]))), max(way, float(np.ptp(said)))
            noise = max(noise, float(np.std(np.diff(piece[:, 0], n=2))) / np.sqrt(6))
        if min(moved, own) > max(MOVED * noise, SHARE * way, SHARE * own):
            found.append(Dead(relation, value, moved))
    return found


def judge_dead(
    model: Model, trials: Sequence[Trial], shown: Sequence[int]
) -> list[tuple[int, Dead]]:
    """Where a velocity's sensor shows nothing: (which trial, what).

    Raises:
        GroundedError: for a velocity that no trial shows.
    """
    relations = [r for r in integrals(model) if {r.i, r.j} <= set(shown)]
    found = [(k, one) for k, t in enumerate(trials) for one in dead_rates(model, t, relations)]
    for j in {one.relation.j for _, one in found}:
        of_it = [(k, one) for k, one in found if one.relation.j == j]
        if len(of_it) == len(trials):
            name = model.state_names[j]
            mend = (
                f"Check the path of [log.state.{name}], or leave that table out and estimate "
                f"{name} ([estimate])"
            )
            clause = f"{name} {of_it[0][1].told(model)}: its sensor shows nothing"
            raise unusable(trials, [k for k, _ in of_it], clause, mend)
    return found
