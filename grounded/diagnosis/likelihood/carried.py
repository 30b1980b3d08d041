"""Rollouts of a simulator with losses of joints, at about one call of the simulator per step.

The loss of a joint in a step is solved from the speed it would reach without a loss, and from what
a unit of each input adds to all states (`effects.losses`). Computing these with a simulator takes
k + 2 calls per step for k inputs. A loss changes little from step to step, so here each step is
made with the loss of the step before, T-, and corrected to first order,

    x' = f(x, u - T-) - B (T - T-),        w_free = w' + B T-

B changes as slowly as the robot's posture and is computed anew every STEPS_PER_ANSWER steps. Where
T is far from T- (a joint that reverses), the step is repeated with T.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from grounded.diagnosis.likelihood.hypothesis import Hypothesis, adds_to_steps
from grounded.diagnosis.likelihood.moving import moving
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.effects.family import coupled
from grounded.effects.losses import NUDGE, ahead, loads_from, solved
from grounded.frozen import Array

STEPS_PER_ANSWER = 5  # steps after which B is computed anew
# change of a loss, as a fraction of the input's peak, above which a step is repeated
REPEATED_ABOVE = 0.1


def stepper(predictor: Predictor, h: Hypothesis) -> Callable[[Array, Array, Array], Array]:
    """Return the step function of rollouts of a hypothesis: x (M, n), u (M, m), t (M,) -> x."""
    model, dt = predictor.data.model, predictor.data.dt
    if h.losses and simulated(model):
        one = Carried(predictor.data, predictor._inputs)
        return lambda x, u, t: one.advance(h, x, u, t)
    p = predictor.params(h)
    if p.ndim > 1 or adds_to_steps(h):
        return lambda x, u, t: predictor.advance(h, x, u, t)

    def plainly(x: Array, u: Array, t: Array) -> Array:
        if u.shape[-1] > model.m:
            return predictor.advance(h, x, u, t)
        return model.system.step(x, u, p, dt)

    return plainly


@dataclass(frozen=True, eq=False, kw_only=True)
class Carried(Predictor):
    """A predictor for rollouts: successive steps of the same rows (M, n)."""

    memory: dict[str, Any] = field(default_factory=dict)

    def moved(self, h: Hypothesis, x: Array, u: Array, dt: float | None = None) -> Array:
        """Return the model's step with the joints' losses, without added or limited rates."""
        pairs = h.losses
        if dt is not None or not pairs or moving(h, self.seen):
            return super().moved(h, x, u, dt)
        inputs, seen, p = self.data.model.input_names, self.seen, self.params(h)
        u = u[..., : len(inputs)]  # leads would take two more calls of the simulator
        drives = [inputs.index(coupled(effect.site)[0]) for effect, _ in pairs]
        lost = self.memory.get("lost", np.zeros((*x.shape[:-1], len(inputs))))
        before = u - lost
        after = self.step(x, before, p)
        if self.memory.get("age", 0) % STEPS_PER_ANSWER == 0:
            self.memory["B"] = self._answers(x, before, p, after, set(drives))
        B = self.memory["B"]
        free = after + sum(B[tau] * lost[..., tau, None] for tau in B)
        answers = {inputs[tau]: self.named(by) for tau, by in B.items()}
        given = dict(zip(inputs, np.moveaxis(u, -1, 0), strict=True))
        at = loads_from(pairs, self.named(x), given, self.named(free), answers)
        losses, now = solved(pairs, at, self.data.dt), np.zeros_like(lost)
        for tau, loss in zip(drives, losses, strict=True):
            now[..., tau] += loss
        found = after - sum(B[tau] * (now - lost)[..., tau, None] for tau in B)
        _, peaks, _ = self.taken.unit
        again = (np.abs(now - lost) > REPEATED_ABOVE * peaks).any(axis=-1)
        if again.any():
            found[again] = self.step(x[again], (u - now)[again], p if p.ndim == 1 else p[again])
        for q, by in ahead(pairs, at, losses, self.data.dt, self.positions).items():
            found[..., seen.index(q)] += by
        self.memory.update(lost=np.nan_to_num(now), age=self.memory.get("age", 0) + 1)
        return np.asarray(found)

    def _answers(
        self, x: Array, u: Array, p: Array, after: Array, which: set[int]
    ) -> dict[int, Array]:
        """Return B: what a unit of each input, held over the step, adds to all states (..., n)."""
        found = {}
        for tau in sorted(which):
            more = u.copy()
            more[..., tau] += NUDGE
            found[tau] = (self.step(x, more, p) - after) / NUDGE
        return found
