"""Tracker: an extended Kalman filter that runs with the robot (footnotes 15 and 18).

    tracker.sent(t, u)             a command was sent at time t
    tracker.update(t, y)           the sensors measured y at time t
    tracker.state_at(t)            the state at time t, for the controller

The rates are independent: the camera may run at 30 Hz, the controller at 20 Hz. A policy's runner
uses the controller of the nearest control step (`grounded.onboard`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded.checks import wrong
from grounded.estimate.measurement import Measurement, NoiseStd, of_states
from grounded.estimate.record import Record
from grounded.filter.kalman import predicted
from grounded.frozen import Array
from grounded.model import Model

LONGEST_STEP = 0.1  # [s] longer predictions are made in several steps


class Tracker:
    """State and covariance of a running robot.

    Args:
        model: n states, m inputs.
        noise: process and measurement noise.
        start: the state at `time`, (n,).
        start_std: its standard deviation, (n,).
        measurement: what is measured; None for the states themselves.
        latency: transport delay of each input [s], (m,); None for zero.
        past: the input held before the first command, (m,); None for zero.
        time: start time [s].

    Raises:
        GroundedError: if sizes do not match.
    """

    def __init__(
        self,
        model: Model,
        noise: NoiseStd,
        start: Array,
        start_std: Array,
        *,
        measurement: Measurement | None = None,
        latency: Array | None = None,
        past: Array | None = None,
        time: float = 0.0,
    ) -> None:
        self.model, self.noise = model, noise
        self.measurement = of_states(model) if measurement is None else measurement
        self.latency = np.zeros(model.m) if latency is None else np.asarray(latency, float)
        self.past = np.zeros(model.m) if past is None else np.asarray(past, float)
        self.state, self.time = np.array(start, float), float(time)
        std = np.array(start_std, float)
        self.covariance = np.diag(std**2)
        sizes = (len(self.state), len(std), len(noise.process), len(noise.measurement))
        if sizes != (model.n, model.n, model.n, self.measurement.ny):
            wanted = str((model.n, model.n, model.n, self.measurement.ny))
            raise wrong("start, start_std, process and measurement noise", sizes, shape=wanted)
        self._times: list[float] = []
        self._commands: list[Array] = []

    @property
    def std(self) -> Array:
        """Standard deviations of the state, (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def sent(self, t: float, u: Sequence[float] | Array) -> None:
        """Add a command (m,) sent at time t [s], which is held until the next one.

        Raises:
            GroundedError: if t is before the last command.
        """
        if self._times and t <= self._times[-1]:
            if t < self._times[-1]:
                raise wrong("time of a command", t, must="ascending")
            self._commands[-1] = np.array(u, float)
            return
        self._times.append(float(t))
        self._commands.append(np.array(u, float))
        oldest = self.time - float(self.latency.max()) - 1.0
        while len(self._times) > 1 and self._times[1] < oldest:
            self.past = self._commands.pop(0)
            self._times.pop(0)

    def predict(self, t: float) -> Array:
        """Advance the estimate to time t [s] and return the state (n,); ignores earlier times."""
        self.state, self.covariance = self._predicted(t)
        self.time = max(self.time, float(t))
        return self.state

    def state_at(self, t: float) -> Array:
        """Return the state (n,) predicted for time t [s], without changing the estimate."""
        return self._predicted(t)[0]

    def update(self, t: float, y: Sequence[float] | Array) -> float:
        """Correct the estimate with a measurement (ny,) at time t [s]; NaN for missing channels.

        Returns:
            The normalised innovation squared, about 1 on average. NaN if the measurement was not
            used, because all of it is missing or it is older than the estimate.
        """
        y = np.array(y, float)
        seen = np.isfinite(y)
        if t < self.time - 1e-9 or not seen.any():
            return float("nan")
        self.predict(t)
        x, P = self.state, self.covariance
        H = self.measurement.jacobian(x[None])[0][seen]
        e = self.measurement.innovation(y[None], self.measurement.function(x[None]))[0][seen]
        R = np.diag(self.noise.measurement[seen] ** 2)
        S = H @ P @ H.T + R
        K = np.linalg.solve(S, H @ P).T
        kept = np.eye(len(x)) - K @ H
        self.state = x + K @ e
        self.covariance = kept @ P @ kept.T + K @ R @ K.T
        return float(e @ np.linalg.solve(S, e)) / int(seen.sum())

    def _predicted(self, t: float) -> tuple[Array, Array]:
        x, P = self.state, self.covariance
        if t <= self.time + 1e-9:
            return x, P
        system, p = self.model.system, self.model.values
        count = int(np.ceil((t - self.time) / LONGEST_STEP - 1e-9))
        times = np.linspace(self.time, t, count + 1)
        h = float(times[1] - times[0])
        Q = self.noise.process[None] ** 2 * h / self.noise.dt
        for u in self._received(times):
            A = system.linearise(x[None], u[None], p, h)[0][0]
            x = system.step(x[None], u[None], p, h)[0]
            P = predicted(P[None], A[None], Q)[0]
        return x, P

    def _received(self, times: Array) -> Array:
        """Return what the actuators receive over each step, (T, m)."""
        if not self._times:
            return np.tile(self.past, (len(times) - 1, 1))
        nothing = np.zeros((len(times), 0))
        record = Record(times, nothing, np.array(self._times), np.array(self._commands), self.past)
        return record.received(self.latency)[0]
