"""Plant: a simulated REAL system for examples and studies. The search never sees inside it.

Unlike a rollout of the model, commands reach the actuators after their true delay, which is
resolved more finely than the control step; the policy receives measured states; start states
scatter; and the plant's model may have states and effects that the crude model lacks. A run returns
a Trial of MEASURED states and COMMANDED inputs, as a robot does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from grounded.checks import known
from grounded.frozen import Array
from grounded.model import Model
from grounded.onboard import Runner
from grounded.policy import Policy
from grounded.trial import Trial


@dataclass(frozen=True)
class Noise:
    """Standard deviations by state name, in the state's unit; zero for states not named.

    Args:
        start: scatter of the start state.
        process: disturbance added at each control step.
        measurement: error of each measured sample.
    """

    start: Mapping[str, float] = field(default_factory=dict)
    process: Mapping[str, float] = field(default_factory=dict)
    measurement: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Plant:
    """A simulated real system.

    Args:
        model: the true dynamics; it must have every state and input of the policies it runs.
        latency: true transport delay by input name [s]; zero for inputs not named.
        noise: random variation of the start, the process and the measurements.
        substeps: integration steps within a control step.
    """

    model: Model
    latency: Mapping[str, float] = field(default_factory=dict)
    noise: Noise = field(default_factory=Noise)
    substeps: int = 5

    def run(self, policy: Policy, start: Mapping[str, float], rng: np.random.Generator) -> Trial:
        """Run a policy once; the trial ends early if the run diverges.

        Args:
            policy: what to run.
            start: start state by name; zero for states not named.
            rng: source of the noise.

        Raises:
            GroundedError: if the policy's states or inputs are not the plant's.
        """
        model, H = self.model, policy.horizon
        columns = [self._index(name, model.state_names) for name in policy.state_names]
        order = [self._index(name, model.input_names) for name in policy.input_names]
        for name in self.latency:
            self._index(name, model.input_names)
        x = np.array([start.get(name, 0.0) for name in model.state_names], dtype=float)
        start_std, process, error = self.stds
        x += start_std * rng.standard_normal(model.n)
        runner = Runner(policy)
        commands = np.tile(policy.past, (H, 1))
        measured = np.full((H + 1, len(columns)), np.nan)
        measured[0] = (x + error * rng.standard_normal(model.n))[columns]
        done = H
        for t in range(H):
            commands[t] = runner.action(t * policy.dt, measured[t])
            x = self.advance(x[None], commands[None], t, policy, order)[0]
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

    def advance(
        self, x: Array, commands: Array, t: int, policy: Policy, order: Sequence[int]
    ) -> Array:
        """Return the states (N, n) of N runs after control step t.

        Each substep uses the command that has arrived by its middle.

        Args:
            x: states (N, n) before the step.
            commands: commands sent so far, (N, H, m), in the policy's order of inputs.
            t: index of the step.
            policy: the policy that is run.
            order: index of each of the policy's inputs among the plant's.
        """
        h = policy.dt / self.substeps
        u, values = np.zeros((len(x), self.model.m)), self.model.values
        with np.errstate(all="ignore"):
            for i in range(self.substeps):
                for j, name in enumerate(policy.input_names):
                    age = self.latency.get(name, 0.0) - (i + 0.5) * h
                    row = t - math.ceil(age / policy.dt - 1e-9) if age > 0 else t
                    u[:, order[j]] = commands[:, row, j] if row >= 0 else policy.past[j]
                x = self.model.system.step(x, u, values, h)
        return x

    @property
    def stds(self) -> Array:
        """Standard deviations of start, process and measurement, (3, n)."""
        found, noise = np.zeros((3, self.model.n)), self.noise
        named = (noise.start, noise.process, noise.measurement)
        for row, by_name in zip(found, named, strict=True):
            for name, value in by_name.items():
                row[self._index(name, self.model.state_names)] = value
        return found

    @staticmethod
    def _index(name: str, names: tuple[str, ...]) -> int:
        known("state or input", [name], names, "the simulated system")
        return names.index(name)
