"""The closed-loop car on ESTIMATED states: circle and figure-8 (footnotes 15 and 18).

The same search as in `car`, on the same simulated real car with its scatter, twice: on estimated
states (camera), and, for comparison, on the true states at the same instants (true).

    camera, 30 Hz     front and rear marker, each with noise   -> extended Kalman filter (`Tracker`)
    each new estimate the controller of the nearest 20 Hz step -> command, sent at once
    afterwards        the smoother over all frames             -> the stored trial, 20 Hz

The filter uses the CRUDE model with its modelled latency; the car and its delays are the real ones.
A trial's inputs are the means of what was sent over each control step. The markers do not show the
heading rate, which would drift in the estimate, since disturbances change delta and v without it.
As in the paper, it is computed from rigid-body kinematics: psi_rate = v sin(delta) / L of the
estimate.

Both searches are compared by the TRUE utility, that of the true states in fresh runs under the same
kind of feedback. "Optimum" is the policy of a search that knows the true model, planned without
disturbances: a local optimum, which the trials may exceed. The noise that the filter assumes is
estimated from two minutes of manual driving, where errors of the crude model count as process
noise. Nothing is tuned by manoeuvre or seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from grounded.estimate import Measurement, NoiseStd, Record, Tracker, noise_of, smooth_trials
from grounded.experiments.bench import Bench, optimum, standing_still
from grounded.experiments.car import BUDGET, ITERATIONS, PAPER, real_case
from grounded.experiments.driving import RATE, START, film, hands, markers
from grounded.experiments.jobs import (
    Running,
    StudyTable,
    every,
    improvement,
    mean_text,
    run_study,
)
from grounded.frozen import Array
from grounded.model import Model
from grounded.onboard import Runner
from grounded.plant import Plant
from grounded.policy import Policy
from grounded.search.ask_tell import learn
from grounded.search.candidate import Candidate
from grounded.search.step.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial

FINE = 4  # integration steps of the real car within a frame; 2 of them are a row of the film
ROWS = 2  # rows of the film per frame: 60 Hz contains the frames and the 20 Hz control steps


@dataclass(frozen=True, eq=False)
class Flown:
    """One run as the search sees it, and its true states (n states, m inputs, H steps)."""

    trial: Trial  # smoothed states
    truth: Trial  # true states
    live: Array  # (H + 1, n) estimates nearest to each control step, as the controller had them
    nis: float  # mean normalised innovation squared; 1 if the filter's noise is right


@dataclass(frozen=True, eq=False)
class Filmed:
    """The real car under a camera.

    Args:
        task: the manoeuvre with the crude model and latency, which the filter uses.
        plant: the real car; its noise gives start scatter and disturbances, not the measurements.
        see: what the camera measures.
        camera: noise of each channel [m].
        noise: the noise that the filter assumes.
    """

    task: Task
    plant: Plant
    see: Measurement
    camera: float
    noise: NoiseStd

    def run(self, policy: Policy, rng: np.random.Generator, *, estimated: bool = True) -> Flown:
        """Execute a policy once; without `estimated`, controller and trial get the true states."""
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
    """Return car states (..., 6) with the heading rate implied by the other states [rad/s]."""
    delta, v = x[..., 0], x[..., 1]
    rate = v * np.sin(delta) / model.params["L"].value
    return np.concatenate([x[..., :5], rate[..., None]], axis=-1)


class _Film:
    """The simulation of one run, frame by frame."""

    def __init__(
        self, filmed: Filmed, policy: Policy, frames: int, rng: np.random.Generator
    ) -> None:
        self.filmed, self.policy, self.rng = filmed, policy, rng
        task, plant = filmed.task, filmed.plant
        names = plant.model.state_names
        self.latency = np.array([plant.latency.get(name, 0.0) for name in task.model.input_names])
        scatter, process, _ = plant.stds
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
        """Film frame k and return the estimate after it, (n,)."""
        see = self.filmed.see
        y = see.function(self.x[None])[0]
        self.y[ROWS * k] = y + self.filmed.camera * self.rng.standard_normal(see.ny)
        self.nis.append(self.tracker.update(k / RATE, self.y[ROWS * k]))
        self.live[k] = kinematic(self.tracker.state, self.filmed.task.model)
        return np.asarray(self.live[k])

    def advance(self, k: int, u: Array) -> None:
        """Send command u (m,) at frame k and advance the real car to frame k + 1."""
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
        """Return the run on the control grid."""
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
        """Return a record of the first `count` commands at `times`, with frames y if given."""
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


CAMERA = 0.003  # [m] noise of a marker's position
SPACING = 0.15  # [m] between the markers, measured with a ruler; the wheelbases differ from it
DRIVING = 60.0  # [s] each of FILMS films from which the filter's noise is estimated
FILMS = 2
FRESH = 20
NAMES = ("circle", "figure8")
WAYS = ("camera", "true")


@dataclass(frozen=True)
class EstimatedRun:
    """One search. `true` are true utilities: of the model's policy, the final one, the optimum."""

    manoeuvre: str
    seed: int
    states: str  # "camera" or "true"
    utilities: tuple[float, ...]  # measured in the trials
    true: tuple[float, float, float]
    trials: int
    nis: float | None  # of the filter, mean over the trials; 1 if its noise is right
    live: tuple[float, float, float] | None  # rms error of the live estimates ...
    smoothed: tuple[float, float, float] | None  # ... and of the trials: [m], [rad], [m/s]

    @property
    def improvement(self) -> float:
        """Improvement of the true utility."""
        return improvement(*self.true[:2])


@dataclass(frozen=True)
class EstimatedResult:
    """All searches."""

    runs: tuple[EstimatedRun, ...]

    def of(self, manoeuvre: str, states: str) -> list[EstimatedRun]:
        """Return the searches of one manoeuvre on one kind of states."""
        return [run for run in self.runs if (run.manoeuvre, run.states) == (manoeuvre, states)]

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain values."""
        return {
            "camera_m": CAMERA,
            "runs": [vars(run) | {"improvement": run.improvement} for run in self.runs],
            "paper": {name: PAPER[name] for name in NAMES},
        }

    def tables(self) -> list[StudyTable]:
        """Return the improvement on estimated and on true states, and errors of the estimates."""
        names = dict.fromkeys(run.manoeuvre for run in self.runs)
        groups = [(name, way, self.of(name, way)) for name in names for way in WAYS]
        told = ("true utility", "improvement", "optimum", "trials an iteration", "paper")
        rows = [(name, way, *_cells(runs), f"{PAPER[name]:.0%}") for name, way, runs in groups]
        title = f"Closed loop on estimated states, markers ±{1e3 * CAMERA:g} mm at {RATE} Hz"
        head2 = ("manoeuvre", "estimate", "position [mm]", "heading [mrad]", "speed [m/s]", "NIS")
        rows2 = [
            row for name, _, runs in groups if runs and runs[0].live for row in _errors(name, runs)
        ]
        return [
            StudyTable(title, ("manoeuvre", "states", *told), tuple(rows)),
            StudyTable("Errors of the estimates, rms over all trials", head2, tuple(rows2)),
        ]


def _cells(runs: list[EstimatedRun]) -> tuple[str, str, str, str]:
    if not runs:
        return "", "", "", ""
    best = np.mean([improvement(run.true[0], run.true[2]) for run in runs])
    each = np.mean([run.trials / max(len(run.utilities), 1) for run in runs])
    first, final, _ = np.mean([run.true for run in runs], axis=0)
    shown = mean_text([run.improvement for run in runs], of_error=".2%")
    return f"{first:.2f} to {final:.2f}", shown, f"{best:.1%}", f"{each:.1f}"


def _errors(name: str, runs: list[EstimatedRun]) -> list[tuple[str, ...]]:
    rows: list[tuple[str, ...]] = []
    for what, rms in (
        ("filter, live", [run.live for run in runs]),
        ("smoother, stored", [run.smoothed for run in runs]),
    ):
        at, heading, speed = np.sqrt(np.mean(np.array(rms, dtype=float) ** 2, axis=0))
        nis = f"{np.mean([run.nis or np.nan for run in runs]):.2f}" if what[0] == "f" else ""
        rows.append((name, what, f"{1e3 * at:.1f}", f"{1e3 * heading:.0f}", f"{speed:.3f}", nis))
    return rows


def run(
    seeds: Sequence[int] = range(4),
    *,
    manoeuvres: Sequence[str] = NAMES,
    **how: Unpack[Running],
) -> EstimatedResult:
    """Run every manoeuvre for each seed, on estimated and on true states."""
    cases = every(manoeuvre=manoeuvres, states=WAYS, seed=map(int, seeds))
    return EstimatedResult(run_study(EstimatedRun, estimated_job, cases, **how))


def assumed_noise(case: Bench, see: Measurement, seed: int) -> NoiseStd:
    """Estimate process and measurement noise of the crude model from manual driving."""
    rng = np.random.default_rng([seed, 13])
    plant, task = case.plant, case.task
    assert task.latency is not None
    films = film(
        plant.model,
        np.array([plant.latency[name] for name in task.model.input_names]),
        [hands(round(DRIVING * RATE), rng) for _ in range(FILMS)],
        see,
        rng,
        camera=CAMERA,
        process=plant.stds[1] / np.sqrt(RATE * task.dt),
    )
    return noise_of(task.model, films, latency=task.latency, measurement=see).noise


def estimated_job(manoeuvre: str, seed: int, states: str) -> dict[str, Any]:
    """Run one job: one search on estimated ("camera") or true states."""
    case = real_case(manoeuvre, seed, True)
    see = markers(SPACING)
    filmed = Filmed(case.task, case.plant, see, CAMERA, assumed_noise(case, see, seed))
    options = SearchOptions(max_trials=BUDGET)
    flights: list[Flown] = []

    def real(candidate: Candidate) -> Trial:
        rng = np.random.default_rng([seed, 11, len(flights)])
        flights.append(filmed.run(candidate.policy, rng, estimated=states == "camera"))
        return flights[-1].trial

    standing = learn(case.task, real, options, max_iterations=ITERATIONS, check=False).standing
    assert standing.incumbent is not None
    first = next(tried for tried in standing.history if tried.accepted)
    policies = (first.candidate.policy, standing.incumbent.candidate.policy, optimum(case)[0])
    return {
        "manoeuvre": manoeuvre,
        "seed": seed,
        "states": states,
        "utilities": standing.utilities,
        "true": [_true_utility(filmed, policy, seed, states) for policy in policies],
        "trials": len(flights),
        **_quality(flights if states == "camera" else []),
    }


def _true_utility(filmed: Filmed, policy: Policy, seed: int, states: str) -> float:
    """Return the mean true utility of fresh runs; a crash counts as a car that never moved."""
    streams = (np.random.default_rng([seed, 17, i]) for i in range(FRESH))
    runs = [filmed.run(policy, rng, estimated=states == "camera").truth for rng in streams]
    utilities = [filmed.task.utility(truth) for truth in runs]
    return float(np.mean(np.maximum(utilities, standing_still(filmed.task))))


def _quality(flights: Sequence[Flown]) -> dict[str, Any]:
    """Return mean NIS and rms errors of position, heading and speed, live and smoothed."""
    whole = [f for f in flights if np.isfinite(f.nis)]
    if not whole:
        return {"nis": None, "live": None, "smoothed": None}
    return {
        "nis": float(np.mean([f.nis for f in whole])),
        "live": _rms(np.concatenate([f.live - f.truth.states for f in whole])),
        "smoothed": _rms(np.concatenate([f.trial.states - f.truth.states for f in whole])),
    }


def _rms(error: Array) -> list[float]:
    """Return rms of position [m], heading [rad] and speed [m/s], from errors (rows, 6)."""
    square = np.mean(error**2, axis=0)
    at, heading, speed = np.sqrt(square[2] + square[3]), np.sqrt(square[4]), square[1] ** 0.5
    return [float(at), float(heading), float(speed)]
