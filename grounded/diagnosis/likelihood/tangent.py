"""First-order steps of a simulator, for finite differences without calling it again."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.moving import moving
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.frozen import Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Tangent(Predictor):
    """A predictor whose model is linear about x (L, B, n), u (L, B, m).

    For differences between its own predictions only.
    """

    x: Array
    u: Array
    p: Array
    after: Array
    slopes_there: tuple[Array, Array]

    def step(self, x: Array, u: Array, p: Array, dt: float | None = None) -> Array:
        """Return the model's own step: linearised along this track, the simulator's elsewhere."""
        if dt is not None or x.shape != self.x.shape or not np.array_equal(p, self.p):
            return super().step(x, u, p, dt)
        f_x, f_u = self.slopes_there
        moved = u[..., : f_u.shape[-1]] - self.u  # without leads
        by_state, by_input = f_x @ (x - self.x)[..., None], f_u @ moved[..., None]
        return np.asarray(self.after + (by_state + by_input)[..., 0])


def tangent(predictor: Predictor, h: Hypothesis, x: Array, u: Array) -> Predictor:
    """Return a predictor linearised about x (L, B, n), u (L, B, m), if the model is a simulator."""
    if not simulated(predictor.data.model):
        return predictor
    if medium := moving(h, predictor.seen):
        return tangent(predictor, medium.still, medium.through(x), u)
    left, p, kept = predictor.left(h, x, u)[0], predictor.params(h), predictor._inputs
    left = left[..., : predictor.data.model.m]
    after, slopes = predictor.step(x, left, p), predictor.slopes(x, left, p)
    return Tangent(predictor.data, kept, x=x, u=left, p=p, after=after, slopes_there=slopes)
