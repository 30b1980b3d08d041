"""One closed-loop run of the car on ESTIMATED states (footnotes 15 and 18).

    camera, 30 Hz     front and rear marker, each with noise   -> extended Kalman filter (`Tracker`)
    each new estimate the controller of the nearest 20 Hz step -> command, sent at once
    afterwards        the smoother over all frames             -> the stored trial, 20 Hz

The filter knows the CRUDE model with its modelled latency; the car and its delays are the real
ones. A trial's inputs are the means of what was sent over each control step.

No marker shows the heading rate: disturbances move delta and v without it, and its estimate drifts
away. As in the paper, rigid-body kinematics gives it: psi_rate = v sin(delta) / L of the estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from grounded.estimate import Measurement, Noise, Record, Tracker, smooth_trials
from grounded.experiments.driving import RATE, START
from grounded.frozen import Array
from grounded.model import Model
from grounded.onboard import Runner
from grounded.plant import Plant
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial

FINE = 4  # integration steps of the real car within a frame; 2 of them are a row of the film
ROWS = 2  # rows of the film a frame: 60 Hz has both the frames and the 20 Hz control steps


@dataclass(frozen=True, eq=False)
class Flown:
    """One run, as the search sees it and as it was. The policy has n states, m inputs, H steps."""

    trial: Trial  # smoothed states
    truth: Trial  # true states
    live: Array  # (H + 1, n) estimates nearest to each control step, as the controller had them
    nis: float  # mean normalised innovation squared; 1 where the filter's noise is right


@dataclass(frozen=True, eq=False)
class Filmed:
    """The real car under a camera.

    Args:
        task: the manoeuvre with the crude model and latency: all that the filter knows.
        plant: the real car; its noise gives start scatter and disturbances, not the measurements.
        see: what the camera measures.
        camera: noise of each channel [m].
        noise: that the filter assumes.
    """

    task: Task
    plant: Plant
    see: Measurement
    camera: float
    noise: Noise

    def run(self, policy: Policy, rng: np.random.Generator, *, estimated: bool = True) -> Flown:
        """Executes a policy once; `estimated` False: the controller is given the true states.

        The trial then holds the true states too.
        """
        frames = round(policy.horizon * policy.dt * RATE)
        film = _Film(self, policy, frames, rng)
        runner = Runner(policy)
        for k in range(frames + 1):
            state = film.seen(k) if estimated else film.x
            if k < frames:
                film.advance(k, runner.action(k / RATE, state))
            if not np.isfinite(film.x).all() or np.abs(film.x).max() > 1e9:
                break
        return film.flown(estimated)


def kinematic(x: Array, model: Model) -> Array:
    """Car states (..., 6) with the heading rate that the other states imply [rad/s]."""
    delta, v = x[..., 0], x[..., 1]
    rate = v * np.sin(delta) / model.params["L"].value
    return np.concatenate([x[..., :5], rate[..., None]], axis=-1)


class _Film:
    """What happens during one run, frame by frame."""

    def __init__(
        self, filmed: Filmed, policy: Policy, frames: int, rng: np.random.Generator
    ) -> None:
        self.filmed, self.policy, self.rng = filmed, policy, rng
        task, plant = filmed.task, filmed.plant
        names = plant.model.state_names
        self.latency = np.array([plant.latency.get(name, 0.0) for name in task.model.input_names])
        scatter = np.array([plant.noise.start.get(name, 0.0) for name in names])
        process = np.array([plant.noise.process.get(name, 0.0) for name in names])
        self.process = process / np.sqrt(FINE * RATE * policy.dt)  # declared per control step
        self.x = np.array(task.start) + scatter * rng.standard_normal(len(names))
        self.true = np.full((ROWS * frames + 1, len(names)), np.nan)
        self.true[0] = self.x
        self.y = np.full((len(self.true), filmed.see.ny), np.nan)
        self.sent = np.tile(policy.past, (frames, 1))
        self.live = np.full((frames + 1, len(names)), np.nan)
        self.nis: list[float] = []
        self.start_std = np.maximum(START, 3 * scatter)
        self.tracker = Tracker(
            task.model,
            filmed.noise,
            task.start,
            self.start_std,
            measurement=filmed.see,
            latency=task.latency,
            past=policy.past,
        )

    def seen(self, k: int) -> Array:
        """Frame k is filmed; the estimate after it, (n,)."""
        see = self.filmed.see
        y = see.function(self.x[None])[0]
        self.y[ROWS * k] = y + self.filmed.camera * self.rng.standard_normal(see.ny)
        self.nis.append(self.tracker.update(k / RATE, self.y[ROWS * k]))
        self.live[k] = kinematic(self.tracker.state, self.filmed.task.model)
        return np.asarray(self.live[k])

    def advance(self, k: int, u: Array) -> None:
        """Command u (m,) is sent at frame k; the real car moves on to frame k + 1."""
        self.sent[k] = u
        self.tracker.sent(k / RATE, u)
        times = (k + np.arange(FINE + 1) / FINE) / RATE
        model = self.filmed.plant.model
        late = self._commands(times, k + 1).received(self.latency)[0]
        for i, received in enumerate(late):
            step = model.system.step(
                self.x[None], received[None], model.values, times[1] - times[0]
            )
            self.x = step[0] + self.process * self.rng.standard_normal(model.n)
            if (i + 1) % (FINE // ROWS) == 0:
                self.true[ROWS * k + (i + 1) // (FINE // ROWS)] = self.x

    def flown(self, estimated: bool) -> Flown:
        """The run on the control grid."""
        policy, rows = self.policy, round(ROWS * RATE * self.policy.dt)
        grid = np.asarray(np.arange(policy.horizon + 1) * policy.dt)
        frames = len(self.sent)
        inputs = self._commands(grid, frames).received(np.zeros(len(self.latency)))[0]
        names = (policy.state_names, policy.input_names)

        def trial(states: Array) -> Trial:
            kept = Trial(states[::rows], inputs, policy.dt, *names, start_inputs=policy.past)
            return kept.until(max(kept.finite_steps, 0))

        truth = trial(self.true)
        near = np.clip(np.rint(grid * RATE).astype(int), 0, frames)
        live = self.live[near]
        if not estimated or truth.steps < policy.horizon:
            return Flown(truth, truth, live, float("nan"))
        return Flown(trial(self._smoothed()), truth, live, float(np.nanmean(self.nis)))

    def _smoothed(self) -> Array:
        filmed, task = self.filmed, self.filmed.task
        times = np.asarray(np.arange(len(self.true)) / (ROWS * RATE))
        record = self._commands(times, len(self.sent), self.y)
        smoothed = smooth_trials(
            task.model, [record], filmed.noise, latency=task.latency, measurement=filmed.see
        )
        return kinematic(smoothed[0].states, task.model)

    def _commands(self, times: Array, count: int, y: Array | None = None) -> Record:
        """The first `count` commands on a clock `times`; with frames y, a record of the run."""
        nothing = np.zeros((len(times), 0))
        return Record(
            times,
            nothing if y is None else y,
            np.arange(count) / RATE,
            self.sent[:count],
            self.policy.past,
            self.filmed.task.start,
            self.start_std,
        )
