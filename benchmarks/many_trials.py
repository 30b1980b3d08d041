"""Measure CPU time and memory of the commands in a workspace of 10,000 trials; run by hand.

    python benchmarks/many_trials.py [--trials 10000] [--candidates 2500] [--folder DIR]

The workspace is the example car-turn after a very long search: each candidate gains a little, is
handed out and run four times with the noise of a real car. A named folder is kept and used again.
Each row is a process of its own; the first one makes the index. `million` ingests one trial of
1,000,000 steps into an empty workspace. Ratios are to the budget.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from helpers import grounded

from grounded.trial import Trial
from grounded_trials import Workspace
from grounded_trials.store.trial_file import trial_bytes, write_trial
from grounded_trials.workspace.identity import encoded

BUDGET = {"status": 1, "propose": 1, "ingest": 1, "report --html": 5, "million": 10}  # [s]
NOISE, LEFT, SEED = 1e-4, 0.2, 7  # [m, m/s, rad]; of the first error, after the last candidate

BYTECODE = str(Path(tempfile.gettempdir()) / "many-trials-bytecode")  # as for users: compiled once


def made(folder, trials, candidates):
    """Make the workspace."""
    if (folder / "grounded.toml").exists():
        return
    w = Workspace.create(folder, example="car-turn")
    config = (folder / "grounded.toml").read_text()
    keys = f"max_trials = 100000\nrepeats = {trials // candidates}\ntolerance = 0.0\n"
    assert "[search]" in config
    head, tail = config.split("[search]\n")
    tail = "\n".join(x for x in tail.split("\n") if x.split("=")[0].strip() not in keys)
    (folder / "grounded.toml").write_text(f"{head}[search]\n{keys}{tail}")
    w.forget()
    first = w.propose().candidate
    w.ingest(w.run(first.id).trial_file)
    stored = w.trials()[0]
    (trial,), meta = (stored.trial,), stored.meta
    for path in [*(folder / "trials").glob("*-*"), *(folder / "candidates").glob("c*")]:
        path.unlink()
    rng, task, number = np.random.default_rng(SEED), w.task, 0
    aim = task.target
    off = np.nan_to_num(trial.states - aim)
    for k in range(candidates):
        share = LEFT ** (k / candidates)
        policy = replace(first.policy, feedforward=first.policy.feedforward * (1 + 1e-5 * k))
        states = trial.states - (1 - share) * off
        sent = policy.commands(states[None, :-1], policy.past)[0]
        one = replace(
            first,
            id=f"c{k + 1:04d}",
            policy=policy,
            iteration=k,
            base=f"c{k:04d}" if k else "",
            predicted_states=states,
            predicted_inputs=sent,
            damping=0.01 if k else 1.0,
        )
        data = encoded(one, task, "search")
        (folder / "candidates" / f"{one.id}.mcap").write_bytes(data)
        note = {"note": "hand-out", "candidate": one.id, "after": ""}
        note["sha256"] = hashlib.sha256(data).hexdigest()
        keep(folder, "n", k + 1, json.dumps(note, sort_keys=True).encode(), ".json")
        for _ in range(trials // candidates):
            number += 1
            ran = replace(
                trial,
                states=states + share * NOISE * rng.standard_normal(states.shape),
                inputs=sent,
                candidate=one.id,
            )
            about = {key: meta[key] for key in ("kind", "task")}
            about |= {"iteration": str(k), "alpha": repr(one.alpha)}
            keep(folder, "t", number, trial_bytes(ran, about, data), ".mcap")


def keep(folder, letter, number, data, suffix):
    name = f"{letter}{number:04d}-{hashlib.sha256(data).hexdigest()[:16]}{suffix}"
    (folder / "trials" / name).write_bytes(data)


def long_log(folder, steps=1_000_000):
    """Write a trial of so many steps that ran no candidate."""
    if not (folder / "grounded.toml").exists():
        w = Workspace.create(folder, example="pendulum")
        rng = np.random.default_rng(SEED)
        model, dt = w.base_model, w.config.task.dt
        trial = Trial(
            states=rng.standard_normal((steps + 1, model.n)),
            inputs=rng.standard_normal((steps, model.m)),
            dt=dt,
            state_names=tuple(model.states),
            input_names=tuple(model.inputs),
        )
        write_trial(folder / "long.mcap", trial, {"kind": "trial"})
    for path in (folder / "trials").glob("*-*"):
        path.unlink()


def timed(name, *command):
    """Run a command and print its row."""
    ran = grounded(*command, PYTHONDONTWRITEBYTECODE="", PYTHONPYCACHEPREFIX=BYTECODE)
    budget = BUDGET.get(name.split(",")[0])
    ratio = f"{ran.seconds / budget:5.2f} of {budget} s" if budget else " " * 10
    print(f"{name:24} {ran.seconds:7.2f} s CPU {ratio}; {ran.megabytes:6.0f} MB", flush=True)
    if ran.status:
        print(ran.out)
    return ran.out


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=10_000)
    parser.add_argument("--candidates", type=int, default=2_500)
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    place = given.folder or Path(tempfile.mkdtemp(prefix="many-"))
    folder, long = place / "many", place / "long"
    made(folder, given.trials, given.candidates)
    at = ("-C", str(folder))
    (folder / "trials" / ".index.json").unlink(missing_ok=True)
    timed("status, first", *at, "status")
    for _ in range(3):
        timed("status", *at, "status")
    timed("propose, new", *at, "propose")
    timed("propose", *at, "propose")
    told = timed("run", *at, "run", "--json")
    told = json.loads(told[told.index("{\n") :])  # notes on stderr come before
    timed("ingest", *at, "ingest", told["trial_file"])
    timed("report", *at, "report")
    timed("report --html", *at, "report", "--html")
    size = (folder / "reports" / "report.html").stat().st_size / 2**20
    print(f"{'':24} {size:.1f} MB of page")
    timed("verify", *at, "verify")
    long_log(long)
    timed("million", "-C", str(long), "ingest", "--data", str(long / "long.mcap"))


if __name__ == "__main__":
    main()
