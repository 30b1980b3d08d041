"""Norm-optimal iterative learning control, the field that the paper calls closest to its own.

A manoeuvre repeated from the same start is a map from inputs to states. Linearised ONCE, along the
run that the crude model predicts, and stacked over time (the "lifted" model),

    delta x = G_x delta v,        delta u = G_u delta v,

where v is the feed-forward and u contains the feedback of fixed gains. After each trial with states
x and inputs u the next feed-forward is v + delta v with

    delta v = argmin  |x + G_x delta v - target|^2_W + |u + G_u delta v|^2_R
                      + |D (u + G_u delta v)|^2_S + mu |delta v|^2

(Amann, Owens & Rogers, "Iterative learning control using optimal feedback and feedforward actions",
Int. J. Control 65, 1996; Bristow, Tharayil & Alleyne, "A survey of iterative learning control",
IEEE Control Systems 26, 2006). The measured error enters directly, like the bias of step 4. Unlike
in the paper's algorithm, the linearisation never moves to the flown path, the gains are fixed, and
every update is accepted without a line search.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.rollout import simulate
from grounded.solve.policy_gradient import adjoint, linearised
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True, eq=False)
class Lifted:
    """Sensitivities to every entry of the feed-forward: G_x (H + 1, n, H m), G_u (H, m, H m)."""

    states: Array
    inputs: Array


def lifted(task: Task, policy: Policy) -> Lifted:
    """Return the model linearised along the run that it predicts for a policy."""
    problem = task.problem()
    run, gain = simulate(problem, policy), policy.gain
    n, m, H = task.model.n, task.model.m, task.horizon
    received = problem.queue.effective(run.z[:-1], run.inputs)
    f_x, f_u = problem.system.linearise(
        run.z[:-1, :n], received, problem.p, problem.dt, problem.smoothing
    )
    G_x, G_u = np.zeros((H + 1, n, H * m)), np.zeros((H, m, H * m))
    nothing = np.zeros(H * m)

    def sent(t: int, j: int) -> Array:
        return G_u[t, j] if t >= 0 else nothing

    for t in range(H):
        G_u[t, np.arange(m), t * m + np.arange(m)] = 1.0
        if gain is not None:
            past = [sent(t - 1 - i, j) for j, d in enumerate(problem.depths) for i in range(d)]
            G_u[t] += gain[t] @ np.vstack([G_x[t], *past])
        moved = np.empty((m, H * m))
        for j, delay in enumerate(problem.delay):
            whole = int(np.floor(delay + 1e-9))
            part = delay - whole
            moved[j] = (1 - part) * sent(t - whole, j) + part * sent(t - whole - 1, j)
        G_x[t + 1] = f_x[t] @ G_x[t] + f_u[t] @ moved
    return Lifted(G_x, G_u)


def update(task: Task, model: Lifted, policy: Policy, trial: Trial) -> Policy:
    """Return the next policy after a whole trial, with the same gains and a new feed-forward."""
    gradient, curvature = _quadratic(task, model, trial)
    mu = np.tile(task.reward.input + task.reward.input_change, task.horizon)
    move = -np.linalg.solve(curvature + np.diag(mu), gradient)
    return replace(policy, feedforward=policy.feedforward + move.reshape(task.horizon, -1))


def gradient_of(task: Task, policy: Policy) -> tuple[float, Array]:
    """Return the utility and its gradient (H, m) by the feed-forward; `task.model` is the truth."""
    problem = task.problem()
    policy = policy.laid_out(policy.state_names, policy.angles, problem.depths)
    run = simulate(task.problem(exact=True), policy)
    answer = np.zeros((*run.inputs.shape, problem.nz)) if policy.gain is None else policy.gain
    slope, _ = adjoint(linearised(problem, run.z, run.inputs), answer, np.ones_like(run.inputs))
    return run.utility, -slope


def _quadratic(task: Task, model: Lifted, trial: Trial) -> tuple[Array, Array]:
    """Return half the gradient and half the curvature of the cost by the feed-forward."""
    H, reward = task.horizon, task.reward
    assert task.input_target is not None
    error = np.nan_to_num(task.model.difference(trial.states, task.target))
    weight = np.tile(reward.state, (H + 1, 1))
    weight[-1] += reward.terminal
    past = task.past if trial.start_inputs is None else trial.start_inputs
    change = np.diff(np.vstack([past, trial.inputs]), axis=0)
    D_u = np.diff(model.inputs, axis=0, prepend=0.0)
    parts = (
        (model.states, weight, error),
        (model.inputs, np.tile(reward.input, (H, 1)), trial.inputs - task.input_target),
        (D_u, np.tile(reward.input_change, (H, 1)), change),
    )
    size = model.states.shape[2]
    gradient, curvature = np.zeros(size), np.zeros((size, size))
    for response, weights, value in parts:
        rows = response.reshape(-1, size)
        scaled = rows * weights.reshape(-1, 1)
        gradient += scaled.T @ value.ravel()
        curvature += scaled.T @ rows
    return gradient, curvature
