"""The inputs already sent: where they sit in z, and what of them reaches the actuator.

z_t = [x_t, q_t] with q_t the past inputs, newest first, input by input. A delay of d + phi steps
(0 <= phi < 1) under a zero-order hold means

    u_eff_t = now * u_t + past q_t          (weights 1 - phi and phi on two neighbours)
    q_{t+1} = [u_t, q_t without the oldest]  for each input.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.compile.problem import Array, Problem


@dataclass(frozen=True, eq=False)
class Queue:
    """Sizes: n states, m inputs, D past inputs in all."""

    n: int
    depths: tuple[int, ...]  # (m,)
    first: tuple[int, ...]  # (m,) index in z of each input's newest past value
    now: Array  # (m,) weight of u_t itself
    past: Array  # (m, D) weights of q_t

    @property
    def nz(self) -> int:
        """Size of z."""
        return self.n + sum(self.depths)

    def effective(self, z: Array, u: Array) -> Array:
        """What the actuator receives: z (..., nz), u (..., m) -> (..., m)."""
        return self.now * u + z[..., self.n :] @ self.past.T

    def after(self, q: Array, u: Array) -> Array:
        """The past inputs one step later: q (..., D), u (..., m) -> (..., D)."""
        later = np.empty_like(q)
        for j, (at, depth) in enumerate(zip(self.first, self.depths, strict=True)):
            at -= self.n
            later[..., at] = u[..., j]
            later[..., at + 1 : at + depth] = q[..., at : at + depth - 1]
        return later

    def shift(self) -> tuple[Array, Array]:
        """q_{t+1} = S q_t + E u_t: S (D, D), E (D, m)."""
        D, m = self.nz - self.n, len(self.depths)
        return self.after(np.eye(D), np.zeros((D, m))).T, self.after(np.zeros((m, D)), np.eye(m)).T


def queue_of(problem: Problem) -> Queue:
    """The queue of a problem: depths and weights from its delays."""
    n, depths = problem.system.n, problem.depths
    starts = np.concatenate([[0], np.cumsum(depths)]).astype(int)
    now, past = np.zeros(len(depths)), np.zeros((len(depths), int(starts[-1])))
    for j, delay in enumerate(problem.delay):
        whole = int(np.floor(delay + 1e-9))
        part = max(0.0, float(delay) - whole)
        part = 0.0 if part < 1e-9 else part
        for steps, weight in ((whole, 1.0 - part), (whole + 1, part)):
            if weight == 0.0:
                continue
            if steps == 0:
                now[j] = weight
            else:
                past[j, starts[j] + steps - 1] = weight
    return Queue(n, depths, tuple(int(n + s) for s in starts[:-1]), now, past)
