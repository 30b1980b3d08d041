"""Run a policy in a simulator and return a Trial; shared by all robots here.

A simulator has `reset()`, `measure()` and `advance(u)`, which advances one simulation step. The
loop is a robot's: measure, ask the policy, send, wait. A transport delay is a
queue of whole simulation steps between the policy and the simulator.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from grounded.model import Model
from grounded.onboard import Runner
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward


class Simulator(Protocol):
    """A simulator in the robot's place."""

    timestep: float  # [s]

    def reset(self) -> None:
        """Return to the start state."""

    def measure(self) -> np.ndarray:
        """Return the measured states (n,), not finite after a failure."""

    def advance(self, u: np.ndarray) -> None:
        """Advance one simulation step with the inputs (m,)."""


@dataclass(frozen=True, eq=False)
class Robot:
    """A simulator behind the robot's interface; `delay` [s] before commands arrive.

    `noise` (n,) is the standard deviation of what is measured, drawn anew in each run.
    """

    simulator: Simulator
    delay: float = 0.0
    noise: np.ndarray | None = None
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    def run(self, policy: Policy) -> Trial:
        """Run once; end early if a measured state is not finite or absurdly large."""
        sim, H = self.simulator, policy.horizon
        steps = round(policy.dt / sim.timestep)
        assert abs(steps * sim.timestep - policy.dt) < 1e-9 * policy.dt, "dt is no whole multiple"
        late = round(self.delay / sim.timestep)
        assert abs(late * sim.timestep - self.delay) < 1e-9, "the delay is no whole multiple"
        queue = deque([np.array(policy.past)] * late)
        runner = Runner(policy)
        sim.reset()
        states, inputs = [self.measured()], []
        for t in range(H):
            command = runner.action(t * policy.dt, states[-1])
            for _ in range(steps):
                queue.append(command)
                sim.advance(queue.popleft())
            measured = self.measured()
            inputs.append(command)
            states.append(measured)
            if not (np.isfinite(measured).all() and np.abs(measured).max() < 1e6):
                states.pop()
                inputs.pop()
                break
        return Trial(
            states=np.array(states),
            inputs=np.array(inputs).reshape(-1, len(policy.input_names)),
            dt=policy.dt,
            state_names=policy.state_names,
            input_names=policy.input_names,
            start_inputs=policy.past,
        )

    def measured(self) -> np.ndarray:
        """Return the measured states (n,)."""
        x = self.simulator.measure()
        return x if self.noise is None else x + self.noise * self.rng.standard_normal(len(x))


def with_true_model(task: Task, model: Model, delay: float = 0.0) -> Task:
    """Return the same task planned in the simulator itself; its first states are the task's.

    States that the crude model lacks (activations) start at zero and have no weight.
    """
    more = model.n - task.model.n
    nothing, free = np.zeros(more), np.full(more, np.inf)
    return replace(
        task,
        model=model,
        target=np.hstack([task.target, np.full((task.horizon + 1, more), np.nan)]),
        reward=Reward(
            np.append(task.reward.state, nothing),
            np.append(task.reward.terminal, nothing),
            task.reward.input,
            task.reward.input_change,
        ),
        start=np.append(task.start, nothing),
        latency=np.full(task.model.m, delay),
        safety_low=np.append(task.safety_low, -free),
        safety_high=np.append(task.safety_high, free),
    )


def task_of(
    model: Model,
    dt: float,
    target: np.ndarray,
    start: np.ndarray,
    limits: float | np.ndarray,
    *,
    state: dict[str, float],
    input: float | list[float],
    terminal: dict[str, float] | None = None,
    change: float | list[float] = 0.0,
    past: np.ndarray | None = None,
) -> Task:
    """Return a Task from weights by name and symmetric limits of the inputs."""
    terminal = terminal or {}
    return Task(
        model=model,
        dt=dt,
        target=target,
        reward=Reward(
            np.array([state.get(name, 0.0) for name in model.state_names]),
            np.array([terminal.get(name, 0.0) for name in model.state_names]),
            np.broadcast_to(np.asarray(input, dtype=float), (model.m,)),
            np.broadcast_to(np.asarray(change, dtype=float), (model.m,)),
        ),
        start=start,
        past=np.zeros(model.m) if past is None else past,
        low=np.broadcast_to(-np.asarray(limits, dtype=float), (model.m,)),
        high=np.broadcast_to(np.asarray(limits, dtype=float), (model.m,)),
    )


def minimum_jerk(start: np.ndarray, end: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Return a minimum-jerk path, rest to rest, at time fractions (H + 1,) clipped to [0, 1]."""
    s = np.clip(part, 0.0, 1.0)[:, None]
    return start + (end - start) * (10 * s**3 - 15 * s**4 + 6 * s**5)
