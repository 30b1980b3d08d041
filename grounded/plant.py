"""Plant: a simulated REAL system, for examples and studies. The search never sees inside it.

It differs from a model's rollout where reality does: commands reach the actuators after their true
delay, resolved finer than the control step; the policy sees measured states; starts scatter; and
its model may have states and effects that the crude model has no names for. What comes back is a
Trial of MEASURED states and COMMANDED inputs, as from a robot.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from grounded.errors import GroundedError, nearest
from grounded.frozen import Array
from grounded.model import Model
from grounded.onboard import Runner
from grounded.policy import Policy
from grounded.trial import Trial


@dataclass(frozen=True)
class Noise:
    """Standard deviations by state name, zero where not named.

    start: scatter of the start state; process: disturbance added each control step;
    measurement: error of each measured sample.
    """

    start: Mapping[str, float] = field(default_factory=dict)
    process: Mapping[str, float] = field(default_factory=dict)
    measurement: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Plant:
    """A simulated real system.

    Args:
        model: its true dynamics; every state and input of the policy must be among its own.
        latency: true transport delay of each input [s], zero where not named.
        noise: what differs from run to run.
        substeps: integration steps within a control step.
    """

    model: Model
    latency: Mapping[str, float] = field(default_factory=dict)
    noise: Noise = field(default_factory=Noise)
    substeps: int = 5

    def run(self, policy: Policy, start: Mapping[str, float], rng: np.random.Generator) -> Trial:
        """Executes a policy once from a start state given by name; ends early if it diverges.

        Raises:
            GroundedError: if the policy's states or inputs are not the plant's.
        """
        model, H = self.model, policy.horizon
        columns = [self._index(name, model.state_names) for name in policy.state_names]
        order = [self._index(name, model.input_names) for name in policy.input_names]
        for name in self.latency:
            self._index(name, model.input_names)
        x = np.array([start.get(name, 0.0) for name in model.state_names], dtype=float)
        x += self._std(self.noise.start) * rng.standard_normal(model.n)
        process, error = self._std(self.noise.process), self._std(self.noise.measurement)
        runner = Runner(policy)
        commands = np.tile(policy.past, (H, 1))
        measured = np.full((H + 1, len(columns)), np.nan)
        measured[0] = (x + error * rng.standard_normal(model.n))[columns]
        done = H
        for t in range(H):
            commands[t] = runner.action(t * policy.dt, measured[t])
            x = self._advance(x, commands, t, policy, order)
            x = x + process * rng.standard_normal(model.n)
            if not np.isfinite(x).all() or np.abs(x).max() > 1e9:
                done = t
                break
            measured[t + 1] = (x + error * rng.standard_normal(model.n))[columns]
        return Trial(
            states=measured[: done + 1],
            inputs=commands[:done],
            dt=policy.dt,
            state_names=policy.state_names,
            input_names=policy.input_names,
            start_inputs=policy.past,
        )

    def _advance(
        self, x: Array, commands: Array, t: int, policy: Policy, order: list[int]
    ) -> Array:
        """One control step in substeps, each with the commands that have arrived by its middle."""
        h = policy.dt / self.substeps
        u = np.zeros(self.model.m)
        for i in range(self.substeps):
            for j, name in enumerate(policy.input_names):
                age = self.latency.get(name, 0.0) - (i + 0.5) * h
                row = t - int(np.ceil(age / policy.dt - 1e-9)) if age > 0 else t
                u[order[j]] = commands[row, j] if row >= 0 else policy.past[j]
            with np.errstate(all="ignore"):
                x = self.model.system.step(x[None], u[None], self.model.values, h)[0]
        return x

    def _std(self, by_name: Mapping[str, float]) -> Array:
        std = np.zeros(self.model.n)
        for name, value in by_name.items():
            std[self._index(name, self.model.state_names)] = value
        return std

    @staticmethod
    def _index(name: str, names: tuple[str, ...]) -> int:
        if name not in names:
            raise GroundedError(f"the simulated system has no '{name}': {nearest(name, names)}")
        return names.index(name)
