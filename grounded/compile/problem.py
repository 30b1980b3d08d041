"""A finite-horizon tracking problem in plain arrays, and what is computed with it.

The state a kernel works on is augmented with the inputs already sent, newest first, input by input,

    z_t = [x_t, q_t] = [x_t, u_0[t-1] .. u_0[t-D_0], u_1[t-1] .. u_1[t-D_1], ...],

because two things need them: the cost of input CHANGES (u_t - u_{t-1}) and the transport DELAY of
an input. D_j = max(1, ceil(delay_j)); with delay_j = d + phi (0 <= phi < 1, in steps) the actuator
receives, under a zero-order hold, the mean over the step (1 - phi) u_j[t-d] + phi u_j[t-d-1].

    u_eff_t = now * u_t + past q_t,        q_{t+1} = [u_t, q_t without the oldest]  (`Queue`)
    x_{t+1} = f(x_t, u_eff_t - input_shift_t) + bias_t
    J = sum_t  W_t |x_t - target_t|^2 + R |u_t - u_target_t|^2 + S |u_t - u_{t-1}|^2
        + W_H |x_H - target_H|^2,                         low <= u_t <= high

J is a COST: minus the paper's utility. Errors of states marked as angles wrap to [-pi, pi].

A `System` is the model: compiled or differenced (`run`), the same to all that is above, so that a
black-box simulator serves as well as machine code. All arrays are float64 and C-contiguous.
A state that leaves the finite numbers is returned as it is (NaN, inf), never raised: the caller
turns it into a status.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from grounded.frozen import Array

if TYPE_CHECKING:
    from grounded.compile.run.interpreted import System

# Box-limited quadratic programmes, see `llvm_box`.
MAX_ITERATIONS = 50
STOP = 1e-11  # on the free gradient, relative to |g|
ARMIJO = 0.1
ROUNDING = 1e-13  # of the value: a smaller rise is none

# The loop of `ddp.descended` and its compiled twin `llvm_descent`.
FLOOR = 1e-6  # first regularisation after a failed factorisation
SEARCH_FLOOR = 1e-3  # regularisation after a failed search
GROWTH = 10.0
CEILING = 1e10
LARGE_MU = 1.0
NO_CHANGE = 1e-14  # a predicted change that is none
Status = Literal["converged", "no improvement", "max iterations", "not finite"]
STATUSES: tuple[Status, ...] = ("converged", "no improvement", "max iterations", "not finite")

Limits = tuple[Array, Array]


def history_depths(delay: Array) -> tuple[int, ...]:
    """Past inputs kept for each input, D_j = max(1, ceil(delay_j)); delay (m,) in steps."""
    return tuple(max(1, int(np.ceil(d - 1e-9))) for d in delay)


def deepest(depths: tuple[int, ...], others: tuple[int, ...]) -> tuple[int, ...]:
    """For each input the larger of two depths; without `others`, those given."""
    return tuple(map(max, depths, others)) if others else depths


@dataclass(frozen=True, eq=False)
class Problem:
    """Sizes: n states, m inputs, k parameters, H steps, D = sum of the history depths."""

    system: System
    p: Array  # (k,) parameter values
    dt: float  # [s]
    start: Array  # (n,) s_0
    past: Array  # (m,) the input that was held before t = 0
    delay: Array  # (m,) transport delay in steps, any fraction
    bias: Array  # (H, n) added to every step (step 4); zeros for the model as it is
    target: Array  # (H + 1, n); entries that are not tracked have weight 0
    state_weight: Array  # (H + 1, n); row H already includes the terminal weight
    input_target: Array  # (H, m)
    input_weight: Array  # (m,) R
    change_weight: Array  # (m,) S
    low: Array  # (m,) hard limits, may be -inf
    high: Array  # (m,) may be +inf
    angles: NDArray[np.bool_]  # (n,)
    input_shift: Array | None = None  # (H, m) off what the actuators receive, see `bias`
    age: float = 0.0  # [s] of the samples that a policy acts on, see `rollout.seen_late`
    smoothing: float = 0.0  # width of the smoothed indicator terms; 0: exact
    fed_back: tuple[int, ...] = ()  # past inputs of each that z holds at least, for policies

    @property
    def horizon(self) -> int:
        """H, the number of control steps."""
        return int(self.bias.shape[-2])

    @cached_property
    def depths(self) -> tuple[int, ...]:
        """Past inputs in z for each input: those on their way, and those that are fed back."""
        return deepest(history_depths(self.delay), self.fed_back)

    @cached_property
    def input_scale(self) -> Array:
        """The natural unit of damping for each input (m,): the curvature 2 (R + S) of its own cost.

        An input without a cost of its own takes the mean of the others, or 1.
        """
        scale = 2.0 * (self.input_weight + self.change_weight)
        positive = scale[scale > 0]
        return np.where(scale > 0, scale, positive.mean() if positive.size else 1.0)

    @property
    def nz(self) -> int:
        """Size of the augmented state z."""
        return self.system.n + sum(self.depths)

    @cached_property
    def queue(self) -> Queue:
        """Where the past inputs sit in z, and what of them reaches the actuator."""
        return queue_of(self.system.n, self.delay, self.depths)

    def received(self, z: Array, u: Array, t: int | slice = slice(None)) -> Array:
        """What the model is given at steps t: z (..., nz), u (..., m) -> (..., m)."""
        sent = self.queue.effective(z, u)
        return sent if self.input_shift is None else sent - self.input_shift[t]

    @property
    def limits(self) -> Limits:
        """The lowest and the highest inputs, (m,) each."""
        return self.low, self.high

    def z_start(self) -> Array:
        """z_0: the start state and the input held before it, (nz,)."""
        held = [np.full(d, self.past[j]) for j, d in enumerate(self.depths)]
        return np.concatenate([self.start, *held])


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


def queue_of(n: int, delay: Array, depths: tuple[int, ...]) -> Queue:
    """The queue of n states and inputs delayed by `delay` (m,) steps."""
    starts = np.concatenate([[0], np.cumsum(depths)]).astype(int)
    now, past = np.zeros(len(depths)), np.zeros((len(depths), int(starts[-1])))
    for j, steps in enumerate(delay):
        whole = int(np.floor(steps + 1e-9))
        part = max(0.0, float(steps) - whole)
        part = 0.0 if part < 1e-9 else part
        for age, weight in ((whole, 1.0 - part), (whole + 1, part)):
            if weight and age:
                past[j, starts[j] + age - 1] = weight
            elif weight:
                now[j] = weight
    return Queue(n, depths, tuple(int(n + s) for s in starts[:-1]), now, past)


@dataclass(frozen=True)
class DescentOptions:
    """Settings of `ddp.solve`."""

    max_iterations: int = 100
    tolerance: float = 1e-8  # stop when the predicted change is below this times the cost
    halvings: int = 11  # alpha = 1 ... 1/2^11
    damped: int = 11  # the same where mu damps the step; not by compiled systems
    accept: float = 0.1  # least part of the predicted change
    enough: float = 0.0  # stop after an accepted step that gains less; not by compiled systems


@dataclass(frozen=True, eq=False)
class Descent:
    """Where the loop ended: the last trajectory, the gains of the last sweep, a line a search."""

    status: Status
    z: Array  # (H+1, nz)
    u: Array  # (H, m)
    k: Array  # (H, m)
    K: Array  # (H, m, nz)
    cost: float
    failed_at: int  # "not finite": the step at which the last sweep failed, -1 before the first
    lines: Array  # (i, 4): cost, predicted change, alpha (0: none was accepted), mu


class Samples(NamedTuple):
    """Where N steps are differentiated, see `System.linearise`."""

    x: Array  # (N, n)
    u: Array  # (N, m)
    p: Array  # (k,)
    dt: float
    smoothing: float = 0.0
    limits: Limits | None = None


class Controls(NamedTuple):
    """u_t = clip(ubar_t + alpha k_t + K_t (z_t - zbar_t)), see `System.rollout`."""

    ubar: Array  # (H, m)
    K: Array | None = None  # (H, m, nz)
    zbar: Array | None = None  # (H, nz) or (H+1, nz)
    k: Array | None = None  # (H, m)


@dataclass(frozen=True, eq=False)
class Swarm:
    """The runs of one rollout call, one for each alpha: z (A, H+1, nz), u (A, H, m), cost (A,)."""

    z: Array
    u: Array
    cost: Array


@dataclass(frozen=True, eq=False)
class Backward:
    """One Riccati sweep: u_t = ubar_t + alpha k_t + K_t (z_t - zbar_t).

    The cost is expected to change by alpha d1 + alpha^2 d2 (d1 <= 0 <= d2). `failed_at` is the
    step whose Q_uu was not positive definite or not finite, -1 when the sweep went through.
    """

    k: Array  # (H, m)
    K: Array  # (H, m, nz)
    d1: float
    d2: float
    failed_at: int
