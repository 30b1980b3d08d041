"""Estimation of the car's parameters from half an hour of manual driving (footnote 17).

As in the paper, the wheelbase is measured with a tape and steering angles on the bench for various
inputs; 30 minutes of driving are filmed at 30 Hz. The film gives first values (`first_values`):

    a1, b1          a line through the steering angles measured on the bench
    a2, a3, b2      linear regression over stretches of steady speed
    stall           the largest throttle at which the car stood
    tau_delta, latency, tau_v, a4   from how heading rate and speed follow the inputs

From these, `grounded.fit` maximises the likelihood of all data over parameters, stall threshold and
latency together. Every seed is another car (each parameter +-20 %), another driver and other noise.
The study checks that the stated 95 % intervals contain the true values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Unpack

import numpy as np

from grounded.estimate import Record
from grounded.experiments.driving import RATE, drive
from grounded.experiments.jobs import Job, Running, StudyTable, run_jobs
from grounded.fit import fit
from grounded.frozen import Array
from grounded.model import Model
from grounded.models.car import model as car
from grounded.trial import Trial


def first_values(
    films: Sequence[Record], length: float, angles: tuple[Array, Array]
) -> dict[str, float]:
    """Return initial values by regressions and step responses, as in footnote 17.

    Args:
        films: the camera's records.
        length: wheelbase [m].
        angles: inputs and steering angles from the bench.
    """
    a1, b1 = np.polyfit(*angles, 1)
    runs = [(film.commands, *_seen(film, length)) for film in films]
    steady = np.vstack([_steady(u, v) for u, v, _ in runs])
    moving = steady[(steady[:, 2] > 0.15) & (steady[:, 1] > 0.25)]
    ones = np.ones(len(moving))
    design = np.column_stack([moving[:, 1], np.abs(moving[:, 0]), ones])
    a2, a3, b2 = np.linalg.lstsq(design, moving[:, 2], rcond=None)[0]
    standing = steady[(steady[:, 2] < 0.05) & (np.abs(steady[:, 0]) < 0.3), 1]
    stall = float(np.quantile(standing, 0.98)) if len(standing) else 0.1
    latency, tau_delta = _steering_response(runs, float(a1), float(b1), length)
    tau_v, a4 = _speed_response(runs, (float(a2), float(a3), float(b2)), latency)
    values = {"a1": a1, "b1": b1, "a2": a2, "a3": a3, "b2": b2, "a4": a4, "stall": stall}
    values |= {"tau_delta": tau_delta, "tau_v": tau_v, "latency": latency}
    inside = {}
    for name, value in values.items():
        p = car.params.get(name)
        low, high = (0.0, 0.3) if p is None else (p.low, p.high)
        inside[name] = float(np.clip(value, low, high))
    return inside


def _seen(film: Record, length: float) -> tuple[Array, Array]:
    """Return front-wheel speed [m/s] and heading rate [rad/s] at each frame, (steps,)."""
    front, rear = film.measured[:, :2], film.measured[:, 2:]
    heading = np.unwrap(np.arctan2(*(front - rear).T[::-1]))
    width = 4  # frames on either side
    dt = 2 * width / RATE
    velocity = np.zeros_like(front)
    velocity[width:-width] = (front[2 * width :] - front[: -2 * width]) / dt
    rate = np.zeros(len(front))
    rate[width:-width] = (heading[2 * width :] - heading[: -2 * width]) / dt
    return np.hypot(*velocity.T)[:-1], rate[:-1]


def _steady(u: Array, v: Array) -> Array:
    """Return rows [steering, throttle, speed], means over half a second of long held inputs."""
    rows, hold = [], 0
    for t in range(1, len(u)):
        hold = hold + 1 if np.abs(u[t] - u[t - 1]).max() < 0.1 else 0
        if hold > 60 and hold % 15 == 0:
            window = slice(t - 15, t)
            rows.append([*u[window].mean(axis=0), v[window].mean()])
    return np.array(rows).reshape(-1, 3)


def _lagged(x: Array, tau: float) -> Array:
    """Return the first-order response to x, sampled at RATE, from zero."""
    from scipy.signal import lfilter

    decay = np.exp(-1 / (RATE * tau))
    return np.asarray(lfilter([0.0, 1 - decay], [1.0, -decay], x, axis=0))


def _steering_response(
    runs: Sequence[tuple[Array, Array, Array]], a1: float, b1: float, length: float
) -> tuple[float, float]:
    """Return latency and tau_delta [s] for which v sin(delta) / L fits the heading rate best."""
    best = (np.inf, 0.1, 0.1)
    for frames in range(0, 8):
        for tau in (0.03, 0.05, 0.07, 0.1, 0.14, 0.2, 0.3):
            error = 0.0
            for u, v, rate in runs[:8]:
                late = np.concatenate([np.zeros(frames), u[: len(u) - frames, 0]])
                delta = _lagged(a1 * late + b1, tau)
                error += float(np.sum((rate - v * np.sin(delta) / length) ** 2))
            best = min(best, (error, frames / RATE, tau))
    return best[1], best[2]


def _speed_response(
    runs: Sequence[tuple[Array, Array, Array]], steady: tuple[float, float, float], latency: float
) -> tuple[float, float]:
    """Return tau_v [s] and a4 [m/s^2] from the slopes of the speed after changes of throttle."""
    a2, a3, b2 = steady
    gaps, rises, falls = [], [], []
    frames = round(latency * RATE)
    for u, v, _ in runs:
        late = np.vstack([np.zeros((frames, 2)), u[: len(u) - frames]])
        target = np.maximum(a2 * late[:, 1] + a3 * np.abs(late[:, 0]) + b2, 0.0)
        slope = np.gradient(v) * RATE
        gap = target - v
        up, down = gap > 0.3, (gap < -0.4) & (v > 0.3)
        gaps.append(gap[up])
        rises.append(slope[up])
        falls.append(slope[down])
    gap, rise, fall = (np.concatenate(parts) for parts in (gaps, rises, falls))
    tau = float(gap @ gap / max(float(gap @ rise), 1e-6)) if len(gap) else 0.4
    return tau, float(np.median(fall)) if len(fall) else -1.0


def seen_by_camera(film: Record, length: float) -> Trial:
    """Return a film as a trial: position and heading of the rigid body through both markers."""
    front, rear = film.measured[:, :2], film.measured[:, 2:]
    states = np.full((film.steps + 1, car.n), np.nan)
    heading = np.unwrap(np.arctan2(*(front - rear).T[::-1]))
    half = 0.5 * length * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    states[:, 2:4], states[:, 4] = 0.5 * (front + rear) - half, heading
    names = (car.state_names, car.input_names)
    return Trial(states, film.commands, 1 / RATE, *names, start_inputs=np.zeros(car.m))


BENCH = 0.005  # [rad] noise of a steering angle measured on the bench
FITTED = ("a1", "b1", "a2", "b2", "a3", "a4", "tau_delta", "tau_v", "stall")


@dataclass(frozen=True)
class FitCarResult:
    """True, first and fitted values by seed, and whether the intervals contain the true ones."""

    runs: tuple[dict[str, Any], ...]
    minutes: float

    @property
    def coverage(self) -> dict[str, float]:
        """Share of seeds whose interval contains the true value, by parameter."""
        names = self.runs[0]["params"]
        return {
            name: float(np.mean([run["params"][name]["inside"] for run in self.runs]))
            for name in names
        }

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain values."""
        every = [p["inside"] for run in self.runs for p in run["params"].values()]
        return {
            "minutes": self.minutes,
            "runs": list(self.runs),
            "coverage": self.coverage,
            "coverage_all": float(np.mean(every)),
        }

    def tables(self) -> list[StudyTable]:
        """Return, per parameter, errors of first value and fit, the stated std, the coverage."""
        rows = []
        for name, share in self.coverage.items():
            each = [run["params"][name] for run in self.runs]
            first = np.sqrt(np.mean([(p["first"] - p["true"]) ** 2 for p in each]))
            error = np.sqrt(np.mean([(p["value"] - p["true"]) ** 2 for p in each]))
            std = np.mean([p["std"] for p in each])
            row = (f"{first:.4f}", f"{error:.5f}", f"{std:.5f}", f"{100 * share:.0f} %")
            rows.append((f"{name} [{each[0]['unit']}]", *row))
        head = ("parameter", "first value's error", "fit's error", "stated std", "inside 95 %")
        title = f"Parameters from {self.minutes:g} minutes of driving, {len(self.runs)} cars"
        return [StudyTable(title, head, tuple(rows))]


def fit_car(
    seeds: Sequence[int],
    *,
    minutes: float = 30.0,
    **how: Unpack[Running],
) -> FitCarResult:
    """Run the study, one job per seed.

    Args:
        seeds: seeds of the cars, drivers and noise.
        minutes: duration of driving.
        how: where the jobs run, see `run_jobs`.
    """
    jobs = [Job(fit_car_job, {"seed": int(seed), "minutes": minutes}) for seed in seeds]
    found = run_jobs(jobs, **how)
    return FitCarResult(tuple(found), minutes)


def fit_car_job(seed: int, minutes: float) -> dict[str, Any]:
    """Run one job: drive and film one car, and estimate its parameters."""
    rng = np.random.default_rng(seed)
    truth, latency = true_car(rng)
    records = drive(truth, latency, minutes, rng)
    length = truth.params["L"].value
    first = first_values(records, length, bench_angles(truth, rng))
    begin = np.full(2, first.pop("latency"))
    start = car.with_values({**first, "L": length})
    trials = [seen_by_camera(film, length) for film in records]
    found = fit(start, trials, FITTED, latency=begin, fit_latency="common")
    params = {}
    for name, estimate in found.params.items():
        true = latency if name == "latency" else truth.params[name].value
        params[name] = {
            "true": true,
            "first": estimate.start,
            **{key: getattr(estimate, key) for key in ("value", "std", "low", "high", "unit")},
            "inside": bool(estimate.low <= true <= estimate.high),
        }
    return {"seed": seed, "params": params, "status": found.sentence, "samples": found.samples}


def true_car(rng: np.random.Generator) -> tuple[Model, float]:
    """Return a car with every parameter off by up to 20 %, and its latency [s]."""
    values = {name: param.value * rng.uniform(0.8, 1.2) for name, param in car.params.items()}
    values["b1"] = rng.uniform(-0.04, 0.04)
    return car.with_values(values), float(rng.uniform(0.08, 0.12))


def bench_angles(truth: Model, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return inputs from -1 to 1 and the steering angles [rad] measured at standstill."""
    u = np.linspace(-1, 1, 9)
    p = truth.params
    return u, p["a1"].value * u + p["b1"].value + BENCH * rng.standard_normal(len(u))
