"""Workspaces with results to report, made once for all tests that only read them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cli import grounded
from grounded.errors import NextCommand
from grounded.experiments.figure8 import flight_task
from grounded.models import aircraft
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.search.standing import standing
from grounded.search.step_size import SearchOptions
from grounded.solve.bias import residuals
from grounded.trial import Trial
from grounded_trials.report.findings import Findings, Run
from grounded_trials.report.gathering import gather
from grounded_trials.store.documents import write_document
from grounded_trials.store.trial_file import trial_bytes
from grounded_trials.workspace.folder import Folder
from workspaces import make

DIAGNOSIS: dict[str, Any] = {
    "verdict": {
        "kind": "effect",
        "effects": ["viscous_friction:v"],
        "sentence": "Viscous friction on v explains 90 % of the gap.",
    },
    "where": {
        "channels": [{"name": "v", "share": 0.9, "rms": 0.2, "unit": "m/s"}],
        "times": [{"from": 0.0, "to": 1.0, "share": 0.6}],
        "regions": [{"when": "v > 0.5", "share": 0.7, "occupancy": 0.3}],
        "whiteness": {"x": 0.4, "v": 0.0002},
    },
    "ranking": [
        {
            "effect": "viscous_friction:v",
            "params": {"k": {"value": 0.3, "std": 0.01, "interval": [0.29, 0.33], "unit": "1/s"}},
            "evidence": 40.0,
            "gap_after": 1.1,
            "shrinkage": 0.9,
        },
        {"effect": "delay:force", "params": {}, "evidence": -2.0, "gap_after": 4.0, "shrinkage": 0},
    ],
    "indistinguishable": [["viscous_friction:v", "quadratic_drag:v"]],
    "gap": {
        "horizon_s": 1.0,
        "unit": "noise-normalised rms",
        "before": 4.1,
        "after": 1.1,
        "floor": 1.0,
        "held_out": True,
    },
    "next_trial": "a fast run and a slow one",
    "parameters": {"mass": {"value": 1.4, "std": 0.02, "interval": [1.36, 1.44], "unit": "kg"}},
    "leftover": [
        {
            "channel": "v",
            "size": 0.02,
            "unit": "m/s/s",
            "evidence": 12.0,
            "region": {"when": "x > 0.2", "share": 0.6, "occupancy": 0.3},
        }
    ],
}


@pytest.fixture(scope="session")
def cart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace of a cart, learnt and diagnosed; tests read it or copy it."""
    folder = tmp_path_factory.mktemp("reported") / "cart"
    make(folder)
    assert grounded("-C", folder, "learn").code == 0
    (folder / "reports").mkdir(exist_ok=True)
    write_document(folder / "reports" / "diagnosis.json", DIAGNOSIS)
    return folder


@pytest.fixture
def learnt(cart: Path, tmp_path: Path) -> Path:
    """The learnt workspace of a cart, for a test that changes it."""
    return copied(cart, tmp_path / "w")


@pytest.fixture(scope="session")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A workspace of an RC car after three trials, not diagnosed."""
    folder = tmp_path_factory.mktemp("reported") / "car"
    make(folder, "car-turn")
    assert grounded("-C", folder, "learn", "--trials", 3).code == 0
    return folder


def copied(workspace: Path, to: Path) -> Path:
    """Copy a workspace, for tests that change it."""
    shutil.copytree(workspace, to)
    return to


def damage(folder: Path, pattern: str) -> Path:
    """Flip a byte in the middle of the only file that fits the pattern."""
    (path,) = folder.glob(pattern)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.chmod(0o644)
    path.write_bytes(bytes(data))
    return path


@cache
def gathered(workspace: Path) -> Findings:
    """Return the findings of a workspace that no test changes."""
    return gather(Folder(workspace))


@cache
def many_flights(trials: int = 50) -> Findings:
    """Return findings of the aircraft's noisy figure-8, 3000 steps a trial, without files."""
    task = flight_task(aircraft.model)
    rng = np.random.default_rng(0)
    H, n, m = task.horizon, task.model.n, task.model.m
    target = np.where(np.isfinite(task.target), task.target, 0.0)
    candidates, runs = [], []
    for k in range(trials):
        drift = np.cumsum(rng.normal(0, 0.02, (H + 1, n)), axis=0) / (k + 1)
        states = target + drift + rng.normal(0, 0.01, (H + 1, n))
        inputs = np.clip(task.past + rng.normal(0, 0.05, (H, m)), task.low, task.high)
        policy: Policy = task.policy(inputs, None, None)
        name = f"c{k + 1:04d}"
        base = candidates[-1].id if candidates else ""
        made = Candidate(name, policy, k, 1.0, base, "m", target, inputs, -100.0 / (k + 2))
        candidates.append(made)
        trial = Trial(states, inputs, task.dt, task.model.state_names, task.model.input_names)
        runs.append(replace(trial, id=f"t{k + 1:04d}", candidate=name))
    now = standing(task, candidates, runs, SearchOptions(max_trials=1000), "m")
    by_id = {t.candidate.id: t for t in now.history}
    return Findings(
        name="many",
        task=task,
        nominal={},
        effects=(),
        method="ddp",
        standing=now,
        runs=tuple(
            Run(
                run,
                by_id[run.candidate].candidate,
                by_id[run.candidate].accepted,
                task.utility(run),
                residuals(task, run),
            )
            for run in runs
        ),
        logs=(),
        lost=(),
        diagnosis=None,
        then=NextCommand("propose"),
    )


def diagnosed(folder: Path, **changes: Any) -> None:
    """Write the diagnosis of a workspace, with some of its parts changed."""
    write_document(folder / "reports" / "diagnosis.json", {**DIAGNOSIS, **changes})


def stored(w: Folder, trial: Trial, about: dict[str, Any], policy: bytes | None = None) -> None:
    """Store a trial in a workspace."""
    units = {"state_units": dict(w.base_model.states), "input_units": dict(w.base_model.inputs)}
    w.store.add(trial_bytes(replace(trial, id=""), about, policy, start_ns=0, **units))
