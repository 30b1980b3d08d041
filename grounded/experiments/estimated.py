"""The closed-loop car on ESTIMATED states: circle and figure-8 (footnotes 15 and 18).

The same search as in `car`, on the same simulated real car with its scatter, twice:

    camera   controller and search see what an extended Kalman filter and a smoother make of two
             markers, each wrong by CAMERA, filmed at 30 Hz (`filmed`)
    true     both are given the true states at the same instants

Both are judged by the TRUE utility, that of the true states in fresh runs, flown as the search
flew. "Optimum" is the policy of a search that knows the true model, planned without disturbances:
a local optimum, which the trials may beat. The noise that the filter assumes is estimated from two
minutes of manual driving: what the crude model gets wrong counts as process noise. Nothing is tuned
by manoeuvre or seed.
"""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.estimate import Measurement, Noise, noise_of
from grounded.experiments.bench import Bench, optimum, standing_still
from grounded.experiments.car import BUDGET, ITERATIONS, PAPER, real_case
from grounded.experiments.driving import RATE, film, hands, markers
from grounded.experiments.filmed import Filmed, Flown
from grounded.experiments.jobs import Engine, Job, Progress, Table, improvement, mean_se, run_jobs
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.ask_tell import learn
from grounded.search.standing import Candidate, SearchOptions
from grounded.trial import Trial

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
    utilities: tuple[float, ...]  # what the trials claim
    true: tuple[float, float, float]
    trials: int
    nis: float | None  # of the filter, mean over the trials; 1 where its noise is right
    live: tuple[float, float, float] | None  # rms error of what the controller had ...
    smoothed: tuple[float, float, float] | None  # ... and of the trials: [m], [rad], [m/s]

    @property
    def improvement(self) -> float:
        """Of the true utility."""
        return improvement(*self.true[:2])


@dataclass(frozen=True)
class EstimatedResult:
    """All searches."""

    runs: tuple[EstimatedRun, ...]

    def of(self, manoeuvre: str, states: str) -> list[EstimatedRun]:
        """Searches of one manoeuvre on one kind of states."""
        return [run for run in self.runs if (run.manoeuvre, run.states) == (manoeuvre, states)]

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "camera_m": CAMERA,
            "runs": [vars(run) | {"improvement": run.improvement} for run in self.runs],
            "paper": {name: PAPER[name] for name in NAMES},
        }

    def tables(self) -> list[Table]:
        """Improvement on estimated beside true states, and how good the estimates were."""
        names = dict.fromkeys(run.manoeuvre for run in self.runs)
        groups = [(name, way, self.of(name, way)) for name in names for way in WAYS]
        head = (
            "manoeuvre",
            "states",
            "true utility",
            "improvement",
            "optimum",
            "trials an iteration",
            "paper",
        )
        rows = [(name, way, *_cells(runs), f"{PAPER[name]:.0%}") for name, way, runs in groups]
        title = f"Closed loop on estimated states, markers ±{1e3 * CAMERA:g} mm at {RATE} Hz"
        head2 = ("manoeuvre", "estimate", "position [mm]", "heading [mrad]", "speed [m/s]", "NIS")
        rows2 = [
            row for name, _, runs in groups if runs and runs[0].live for row in _errors(name, runs)
        ]
        return [
            Table(title, head, tuple(rows)),
            Table("Errors of the estimates, rms over all trials", head2, tuple(rows2)),
        ]


def _cells(runs: list[EstimatedRun]) -> tuple[str, str, str, str]:
    if not runs:
        return "", "", "", ""
    mean, se = mean_se([run.improvement for run in runs])
    best = np.mean([improvement(run.true[0], run.true[2]) for run in runs])
    each = np.mean([run.trials / max(len(run.utilities), 1) for run in runs])
    first, final, _ = np.mean([run.true for run in runs], axis=0)
    shown = f"{mean:.1%}" if len(runs) < 2 else f"{mean:.1%} (±{se:.2%})"
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
    engine: Engine | None = None,
    finished: MutableMapping[str, dict[str, Any]] | None = None,
    progress: Progress | None = None,
) -> EstimatedResult:
    """Every manoeuvre for each seed, on estimated and on true states."""
    jobs = [
        Job(one, {"manoeuvre": manoeuvre, "seed": int(seed), "states": states})
        for manoeuvre in manoeuvres
        for states in WAYS
        for seed in seeds
    ]
    found = run_jobs(jobs, engine, finished=finished, progress=progress)
    return EstimatedResult(tuple(_read(result) for result in found))


def _read(result: dict[str, Any]) -> EstimatedRun:
    listed = ("utilities", "true", "live", "smoothed")
    tuples = {key: result[key] and tuple(result[key]) for key in listed}
    return EstimatedRun(**(result | tuples))


def assumed_noise(case: Bench, see: Measurement, seed: int) -> Noise:
    """Process and measurement noise of the crude model on manual driving of the real car."""
    rng = np.random.default_rng([seed, 13])
    plant, task = case.plant, case.task
    per_step = [plant.noise.process.get(name, 0.0) for name in plant.model.state_names]
    assert task.latency is not None
    films = film(
        plant.model,
        np.array([plant.latency[name] for name in task.model.input_names]),
        [hands(round(DRIVING * RATE), rng) for _ in range(FILMS)],
        see,
        rng,
        camera=CAMERA,
        process=np.array(per_step) / np.sqrt(RATE * task.dt),
    )
    return noise_of(task.model, films, latency=task.latency, measurement=see).noise


def one(manoeuvre: str, seed: int, states: str) -> dict[str, Any]:
    """A job: one search on estimated ("camera") or true states."""
    case = real_case(manoeuvre, seed, True)
    see = markers(SPACING)
    filmed = Filmed(case.task, case.plant, see, CAMERA, assumed_noise(case, see, seed))
    options = SearchOptions(max_trials=BUDGET)
    flights: list[Flown] = []

    def real(candidate: Candidate) -> Trial:
        rng = np.random.default_rng([seed, 11, len(flights)])
        flights.append(filmed.run(candidate.policy, rng, estimated=states == "camera"))
        return flights[-1].trial

    standing = learn(case.task, real, options, max_iterations=ITERATIONS).standing
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
    """Mean utility of the true states in fresh runs; a crash counts as a car that never moved."""
    streams = (np.random.default_rng([seed, 17, i]) for i in range(FRESH))
    runs = [filmed.run(policy, rng, estimated=states == "camera").truth for rng in streams]
    utilities = [filmed.task.utility(truth) for truth in runs]
    return float(np.mean(np.maximum(utilities, standing_still(filmed.task))))


def _quality(flights: Sequence[Flown]) -> dict[str, Any]:
    """Mean NIS and rms errors of position, heading and speed, live and smoothed."""
    whole = [f for f in flights if np.isfinite(f.nis)]
    if not whole:
        return {"nis": None, "live": None, "smoothed": None}
    live = np.concatenate([f.live - f.truth.states for f in whole])
    smoothed = np.concatenate([f.trial.states - f.truth.states for f in whole])
    return {
        "nis": float(np.mean([f.nis for f in whole])),
        "live": _rms(live),
        "smoothed": _rms(smoothed),
    }


def _rms(error: Array) -> list[float]:
    """Of position [m], heading [rad] and speed [m/s], from errors (rows, 6)."""
    square = np.mean(error**2, axis=0)
    return [
        float(np.sqrt(square[2] + square[3])),
        float(np.sqrt(square[4])),
        float(square[1] ** 0.5),
    ]
