"""A whole study in memory: cases made, diagnosed, judged. Files and seals are the CLI's."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from grounded.challenge.cases import Case, Kind, make
from grounded.challenge.score import judge, oracle, summary
from grounded.diagnosis.diagnose import Options, diagnose
from grounded.task import Task
from grounded.utility import Reward


def task_of(case: Case) -> Task:
    """The task that a case's owner has: his model, his latency, his limits."""
    n, m = case.model.n, case.model.m
    return Task(
        model=case.model,
        dt=case.dt,
        target=case.target,
        reward=Reward(np.ones(n), np.zeros(n), np.zeros(m), np.zeros(m)),
        start=case.start,
        past=np.zeros(m),
        low=case.low,
        high=case.high,
        latency=case.latency,
    )


def study(
    kind: Kind,
    count: int,
    seed: int,
    *,
    options: Options | None = None,
    only: str | None = None,
    param_error: float | None = None,
    noise: str | None = None,
    progress: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Diagnoses `count` blind cases of a kind and returns the figures of `summary`, with CPU time.

    Args:
        kind: single, double, none or withheld.
        count: cases.
        seed: of everything.
        options: of the diagnosis.
        only: one system instead of all.
        param_error: see `make`.
        noise: see `make`.
        progress: called with each case's marks.
    """
    marks = []
    for case in make(kind, count, seed, only=only, param_error=param_error, noise=noise):
        begin = time.process_time()
        found = diagnose(task_of(case), case.trials, options).to_json()
        spent = time.process_time() - begin
        known = oracle(case.model, case.trials, case.latency, case.label)
        marks.append({**judge(case.label, found, known), "cpu_s": spent})
        if progress is not None:
            progress(marks[-1])
    return summary(marks)
