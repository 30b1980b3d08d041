"""Plant: a simulated REAL system for examples and studies. The search never sees inside it.

Unlike a rollout of the model, commands reach the actuators after their true delay, which is
resolved more finely than the control step; the policy receives measured states; start states
scatter; and the plant's model may have states and effects that the crude model lacks. A run returns
a Trial of MEASURED states and COMMANDED inputs, as a robot does.
"""

from __future__ import annotations

from collections.abc import Mapping
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

        Each substep uses the commands that have arrived by its middle.

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
        noise, n = self.noise, model.n
        start_std, process, error = map(self._stds, (noise.start, noise.process, noise.measurement))
        x += start_std * rng.standard_normal(n)
        runner, h = Runner(policy), policy.dt / self.substeps
        # of each input, by how many control steps what arrives by a substep's middle is old
        middles = (np.arange(self.substeps) + 0.5) * h
        late = np.array([self.latency.get(name, 0.0) for name in policy.input_names])
        ages = np.maximum(np.ceil((late - middles[:, None]) / policy.dt - 1e-9), 0).astype(int)
        commands = np.tile(policy.past, (H, 1))
        measured = [(x + error * rng.standard_normal(n))[columns]]
        for t in range(H):
            commands[t] = runner.action(t * policy.dt, measured[t])
            for age in ages:
                arrived = commands[np.maximum(t - age, 0), np.arange(len(order))]
                u = np.zeros((1, model.m))
                u[0, order] = np.where(age > t, policy.past, arrived)
                with np.errstate(all="ignore"):
                    x = model.system.step(x[None], u, model.values, h)[0]
            x = x + process * rng.standard_normal(n)
            if not np.isfinite(x).all() or np.abs(x).max() > 1e9:
                break
            measured.append((x + error * rng.standard_normal(n))[columns])
        states, names = np.array(measured), (policy.state_names, policy.input_names)
        inputs = commands[: len(states) - 1]
        return Trial(states, inputs, policy.dt, *names, start_inputs=policy.past)

    def _stds(self, by_name: Mapping[str, float]) -> Array:
        """Return standard deviations by state, (n,)."""
        names, found = self.model.state_names, np.zeros(self.model.n)
        for name, value in by_name.items():
            found[self._index(name, names)] = value
        return found

    @staticmethod
    def _index(name: str, names: tuple[str, ...]) -> int:
        known("state or input", [name], names, "the simulated system")
        return names.index(name)
