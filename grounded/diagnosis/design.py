"""Input design: the drive that makes a model's uncertain parameters identifiable.

Drives are tried in the model: multisines (Schroeder 1970: little peak for much power) on all inputs
at once, each input at frequencies of its own, and staircases; slow or quick, at several sizes. Each
is added to the inputs that hold the robot at its start. With the Fisher information F of a drive on
the parameters in units of their priors (`excitation.information`: what a fit of its log will find),
the best maximises

    1/2 log det(I + F)                                                      (D-optimal)

Sizes fall until the run stays inside [safety], also with each parameter a standard deviation of its
prior away. Where no drive without feedback stays there, the states are fed back to the drive's run
by the gains of a linear quadratic regulator about the start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.compile import Problem
from grounded.diagnosis.excitation import KnownNoise, information, safe
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.noise import NoiseModel, Structure
from grounded.diagnosis.validation.identifiable import WEAK
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.rollout import simulate
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

SIZES = (1.0, 0.7, 0.5, 0.35, 0.2, 0.1, 0.05, 0.02)  # of half the input's range
BANDS = ((0.5, 4.0), (1.0, 12.0), (2.0, 40.0))  # cycles in the drive: lowest and highest
TONES = 8  # of a multisine, for each input
TURNS = 2  # ways in which inputs share the frequencies that are tried
NOISE = 0.01  # of a state's range in a drive: noise of a sensor of which no log tells
UNMODELLED = 0.1  # of that: what no model predicts, a step
SILENT = 1e-12  # noise of a state that no sensor shows
FEWEST = 6  # control steps in a cycle
SETTLED = 500  # steps of the regulator's Riccati equation


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive to record, and what its log will tell.

    Args:
        policy: the commands, with feedback where the robot does not stay by itself.
        run: the model's run of it.
        pattern: "multisine" or "staircase".
        cycles: of its slowest and its quickest part.
        size: the share of the inputs' range that it uses.
        left: of each uncertain parameter, the standard deviation after a fit as a share of the
            prior's. It is a bound: of a model that is right but for these values.
        nats: 1/2 log det(I + F).
    """

    policy: Policy
    run: Trial
    pattern: str
    cycles: tuple[float, float]
    size: float
    left: Mapping[str, float]
    nats: float

    @property
    def weak(self) -> tuple[str, ...]:
        """The parameters that its log will leave weak or not identifiable."""
        return tuple(name for name, share in self.left.items() if share > WEAK)


def design(task: Task, steps: int, noise: Array, hidden: tuple[str, ...] = ()) -> Drive | None:
    """Find the drive of a length that tells most of the uncertain parameters.

    Args:
        task: model, start, limits, safety, latency; its target does not matter.
        steps: control steps H of the drive.
        noise: standard deviation of a sample of each state's sensor, (n,); 0 where unknown.
        hidden: states that no sensor shows, such as the memory of adopted effects.

    Returns:
        The drive; None if none stays inside [safety].
    """
    # The largest drive of each pattern that stays inside [safety], with feedback if it must be.
    task = _of_length(task, steps)
    drives = _drives(task, None) or _drives(task, _regulator(task))
    if not drives:
        return None

    # What is known of the sensors; then the drive that tells most.
    moved = np.median([np.ptp(run.states, axis=0) for *_, run in drives], axis=0)
    unseen = [task.model.state_names.index(name) for name in hidden]
    known = _known_noise(noise, moved, unseen, hidden)
    h, best = Hypothesis(shift=np.zeros(task.model.system.k), spread=1.0), None
    for pattern, cycles, size, policy, run in drives:
        F = information(task, [run], h, known)
        whole = F + np.eye(len(F))  # in units of the parameters' priors
        if whole.shape != 2 * (len(task.model.uncertain),) or not np.isfinite(whole).all():
            continue
        nats = 0.5 * float(np.linalg.slogdet(whole)[1])
        if best is None or nats > best.nats:
            shares = np.sqrt(np.diag(np.linalg.inv(whole))).tolist()
            left = dict(zip(task.model.uncertain, shares, strict=True))
            best = Drive(policy, run, pattern, cycles, size, left, nats)
    return best


def _of_length(task: Task, steps: int) -> Task:
    """Return the task with another horizon and nothing to follow."""
    target, inputs = np.full((steps + 1, task.model.n), np.nan), np.tile(task.past, (steps, 1))
    return replace(
        task,
        target=target,
        input_target=inputs,
        reward=Reward(*map(np.zeros, (task.model.n, task.model.n, task.model.m, task.model.m))),
    )


def _known_noise(
    noise: Array, moved: Array, unseen: Sequence[int], hidden: tuple[str, ...]
) -> KnownNoise:
    """Return the noise that drives are judged by: as logged, else a share of what a state moves."""
    size = np.where(moved > 0, moved, 1.0)
    sensor = np.where(noise > 0, noise, NOISE * size)
    log_r, log_q = 2 * np.log(sensor), 2 * np.log(UNMODELLED * sensor)
    for logs in (log_r, log_q):
        logs[list(unseen)] = 2 * np.log(SILENT)
    return KnownNoise(
        NoiseModel(Structure(), log_q, log_r, log_q, np.full(len(size), -60.0)), hidden
    )


def _patterns(task: Task) -> Iterator[tuple[str, tuple[float, float], Array]]:
    """Yield drives of unit size, (H, m) each, with their name and their cycles."""
    H, m = task.horizon, task.model.m
    phase = np.arange(H) / H
    for low, high in BANDS:
        high = min(high, H / FEWEST)
        grid = np.geomspace(low, max(high, low), TONES * m)
        for turn in range(min(TURNS, m) if m > 1 else 1):
            shape = np.empty((H, m))
            for j in range(m):
                tones = grid[(j + turn) % m :: m]
                own = -np.pi * np.arange(TONES) * (np.arange(TONES) + 1 + j) / TONES
                wave = np.sin(2 * np.pi * tones * phase[:, None] + own).sum(axis=1)
                shape[:, j] = wave / np.abs(wave).max()
            yield "multisine", (low, high), shape
            yield "staircase", (low, high), np.round(2 * shape) / 2


def _drives(
    task: Task, gain: Array | None
) -> list[tuple[str, tuple[float, float], float, Policy, Trial]]:
    """Return the largest drive of each pattern: its name, cycles, size, policy and run."""
    # The model as it is, and with each parameter a standard deviation away, unless the robot would
    # then not even stay while its inputs are held: no drive is to blame for that.
    model, problem = task.model, task.problem(exact=True)
    spreads = np.array([one.spread for one in model.params.values()])
    reach = np.array([one.reach for one in model.params.values()])
    moves = np.diag(spreads)[spreads > 0]
    away = [np.clip(model.values + move, *reach.T) for move in (*moves, *-moves)]
    held = _about_its_run(task, np.tile(task.past, (task.horizon, 1)), gain)
    others = [replace(problem, p=values) for values in away]
    others = [one for one in others if held is not None and _run(task, one, held) is not None]

    # The largest size of each.
    up, down = task.high - task.past, task.past - task.low

    def largest(shape: Array) -> tuple[float, Policy, Trial] | None:
        for size in SIZES:
            sent = task.past + size * np.where(shape > 0, shape * up, shape * down)
            policy = _about_its_run(task, sent, gain)
            if policy is None or (run := _run(task, problem, policy)) is None:
                continue
            if all(_run(task, one, policy) is not None for one in others):
                return size, policy, run
        return None

    each = ((pattern, cycles, largest(shape)) for pattern, cycles, shape in _patterns(task))
    return [(pattern, cycles, *made) for pattern, cycles, made in each if made is not None]


def _about_its_run(task: Task, sent: Array, gain: Array | None) -> Policy | None:
    """Return the policy that sends a drive, with feedback to the run that the model makes of it."""
    if gain is None:
        return task.policy(sent, None, None)
    problem, H = task.problem(exact=True), len(sent)
    gains = np.zeros((H, *gain.shape[:1], problem.nz))
    gains[:, :, : gain.shape[1]] = gain
    begin = simulate(problem, task.policy(sent, None, None)).z[0]
    run = simulate(problem, task.policy(sent, gains, np.tile(begin, (H, 1))))
    if not np.isfinite(run.z).all():
        return None
    return task.policy(run.inputs, gains, run.z[:-1])


def _run(task: Task, problem: Problem, policy: Policy) -> Trial | None:
    """Return the run of a policy in a model; None if it leaves [safety] or diverges."""
    run = simulate(problem, policy)
    if not np.isfinite(run.z).all():
        return None
    names = (task.model.state_names, task.model.input_names)
    made = Trial(run.states, run.inputs, task.dt, *names, start_inputs=task.past)
    return made if safe(task, made) else None


def _regulator(task: Task) -> Array:
    """Return the gains (m, n) of a linear quadratic regulator about the start.

    Errors count by [safety], or else by 1 in their unit, and inputs by their limits.
    """
    assert task.safety_low is not None and task.safety_high is not None
    problem = task.problem(exact=True)
    f_x, f_u = problem.system.linearise(task.start[None], task.past[None], problem.p, problem.dt)
    A, B = f_x[0], f_u[0]
    room = 0.5 * (task.safety_high - task.safety_low)
    Q = np.diag(1 / np.where(np.isfinite(room), room, 1.0) ** 2)
    R = np.diag(1 / (0.5 * (task.high - task.low)) ** 2)
    V, K = Q, np.zeros(B.T.shape)
    for _ in range(SETTLED):
        K = -np.linalg.solve(R + B.T @ V @ B, B.T @ V @ A)
        V = Q + A.T @ V @ (A + B @ K)
    return np.asarray(K)
