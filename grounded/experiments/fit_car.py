"""The car's parameters from half an hour of manual driving (footnote 17).

As the paper did it: the wheelbase is measured with a tape; the steering angle is measured on the
bench for various inputs (linear regression: a1, b1); 30 minutes of driving are filmed at 30 Hz;
linear regression over stretches of steady speed gives a2, a3, b2, and step responses give
tau_delta, tau_v, a4 and the latency. From these first values `grounded.fit` climbs the likelihood
of all the data, parameters, stall threshold and latency together.

Every seed is another car (each parameter +-20 %), another driver and other noise. The check: the
stated 95 % intervals hold the true values.
"""

from __future__ import annotations

from collections.abc import MutableMapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.experiments.driving import drive, markers
from grounded.experiments.first_values import first_values
from grounded.experiments.jobs import Engine, Job, Progress, Table, run_jobs
from grounded.fit import fit
from grounded.frozen import Array
from grounded.model import Model
from grounded.models.car import model as car

BENCH = 0.005  # [rad] noise of a steering angle measured on the bench
FITTED = ("a1", "b1", "a2", "b2", "a3", "a4", "tau_delta", "tau_v", "stall")


@dataclass(frozen=True)
class FitCarResult:
    """For each seed the true, first and fitted values, the intervals, and whether they hold."""

    runs: tuple[dict[str, Any], ...]
    minutes: float

    @property
    def coverage(self) -> dict[str, float]:
        """Share of seeds whose interval holds the true value, by parameter."""
        names = self.runs[0]["params"]
        return {
            name: float(np.mean([run["params"][name]["inside"] for run in self.runs]))
            for name in names
        }

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        every = [p["inside"] for run in self.runs for p in run["params"].values()]
        return {
            "minutes": self.minutes,
            "runs": list(self.runs),
            "coverage": self.coverage,
            "coverage_all": float(np.mean(every)),
        }

    def tables(self) -> list[Table]:
        """Per parameter: error of the first value, of the fit, the stated std, the coverage."""
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
        return [Table(title, head, tuple(rows))]


def fit_car(
    seeds: Sequence[int],
    *,
    minutes: float = 30.0,
    engine: Engine | None = None,
    finished: MutableMapping[str, dict[str, Any]] | None = None,
    progress: Progress | None = None,
) -> FitCarResult:
    """The study, one job a seed.

    Args:
        seeds: of the cars, drivers and noise.
        minutes: of driving.
        engine: where the jobs run.
        finished: results of earlier jobs.
        progress: called with jobs done and jobs in all.
    """
    jobs = [Job(one_car, {"seed": int(seed), "minutes": minutes}) for seed in seeds]
    found = run_jobs(jobs, engine, finished=finished, progress=progress)
    return FitCarResult(tuple(found), minutes)


def one_car(seed: int, minutes: float) -> dict[str, Any]:
    """One car: driven, filmed, estimated."""
    rng = np.random.default_rng(seed)
    truth, latency = true_car(rng)
    records = drive(truth, latency, minutes, rng)
    length = truth.params["L"].value
    first = first_values(records, length, bench(truth, rng))
    begin = np.full(2, first.pop("latency"))
    start = car.with_values({**first, "L": length})
    found = fit(
        start,
        records,
        FITTED,
        latency=begin,
        fit_latency="common",
        measurement=markers(length),
        rng=np.random.default_rng(seed),
    )
    params = {}
    for name, estimate in found.params.items():
        true = latency if name == "latency" else truth.params[name].value
        params[name] = {
            "true": true,
            "first": estimate.start,
            "value": estimate.value,
            "std": estimate.std,
            "low": estimate.low,
            "high": estimate.high,
            "unit": estimate.unit,
            "inside": bool(estimate.low <= true <= estimate.high),
        }
    return {"seed": seed, "params": params, "status": found.sentence, "samples": found.samples}


def true_car(rng: np.random.Generator) -> tuple[Model, float]:
    """A car like the model's, every parameter off by up to 20 %, and its latency [s]."""
    values = {name: param.value * rng.uniform(0.8, 1.2) for name, param in car.params.items()}
    values["b1"] = rng.uniform(-0.04, 0.04)
    return car.with_values(values), float(rng.uniform(0.08, 0.12))


def bench(truth: Model, rng: np.random.Generator) -> tuple[Array, Array]:
    """Steering angles [rad] measured by hand for inputs from -1 to 1, car standing."""
    u = np.linspace(-1, 1, 9)
    p = truth.params
    return u, p["a1"].value * u + p["b1"].value + BENCH * rng.standard_normal(len(u))
