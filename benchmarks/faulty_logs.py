"""Put faults into the log of a real run, and see what `ingest` says of each.

    python benchmarks/faulty_logs.py WORKSPACE...

The last whole run of each workspace is written as a table of its control steps, once sound and once
with each fault: a column in another unit, of the other sign, exchanged with another, off by a
constant; commands scaled, negated or of another signal; rows missing at either end. Each is
ingested in a copy of the workspace in which the run is set aside. Printed is how many logs were

    told     refused or warned about, naming the columns at fault and no other
    unsaid   refused without naming a column, or stored with a warning of another kind
    stored   stored without a warning; right for the sound log only
    wrong    refused or warned about with the wrong columns, or by another candidate's name
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.findings import Finding, Weight
from grounded.frozen import Array
from grounded.trial import Trial, interpolate_gaps
from grounded_trials import Workspace

BEFORE = 12  # rows before the run, at its start
DEGREES = 180 / np.pi
FAULTS = ("unit", "folded", "sign", "exchange", "dead", "offset", "zero", "crossed", "stated")
FAULTS = (*(f"log.{kind}" for kind in FAULTS), "run.exchanged")  # of columns
OTHERS = {"log.another", "log.earlier"}  # it ran another candidate


def columns(w: Workspace, trial: Trial) -> tuple[list[str], Array]:
    """Return the names and the rows of a run's table, t first, with rows before it."""
    names = ["t", *trial.state_names, *trial.input_names]
    T = min(trial.steps, w.task.horizon)
    inputs = np.vstack([trial.inputs[:T], trial.inputs[T - 1 : T]])
    rows = np.hstack([trial.states[: T + 1], inputs])
    rest = np.hstack([trial.states[0], w.task.past])
    rows = np.vstack([np.tile(rest, (BEFORE, 1)), rows])
    return names, np.column_stack([100 + trial.dt * np.arange(len(rows)), rows])


def faults(w: Workspace, names: list[str], rows: Array) -> Iterator[tuple[str, set[str], Array]]:
    """Yield each fault's name, the columns at fault, and the rows."""
    model = w.base_model
    units = {**model.states, **model.inputs}
    moving = [n for k, n in enumerate(names) if k and np.ptp(rows[:, k]) > 0]

    def changed(name: str, by: float = 1.0, plus: float = 0.0) -> Array:
        found = np.array(rows)
        found[:, names.index(name)] = by * found[:, names.index(name)] + plus
        return found

    yield "sound", set(), rows
    for name in moving:
        yield f"-{name}", {name}, changed(name, -1.0)
        if units[name] in ("m", "m/s", "V", "N", "A", "N m"):
            yield f"1000 {name}", {name}, changed(name, 1000.0)
        if units[name] in ("rad", "rad/s"):
            yield f"{name} in degrees", {name}, changed(name, DEGREES)
            yield f"{name} / 57.3", {name}, changed(name, 1 / DEGREES)
        if name in model.inputs:
            yield f"0.8 {name}", {name}, changed(name, 0.8)
            yield f"{name} = 0", {name}, changed(name, 0.0)
        else:
            yield (
                f"{name} + half",
                {name},
                changed(name, 1.0, 0.5 * np.ptp(rows[:, names.index(name)])),
            )
    states = [n for n in moving if n in model.states]
    inputs = [n for n in moving if n in model.inputs]
    for every in (states, inputs):
        for a, b in pairwise(every):
            found = np.array(rows)
            i, j = names.index(a), names.index(b)
            found[:, [i, j]] = found[:, [j, i]]
            yield f"{a} <-> {b}", {a, b}, found
    T = len(rows) - BEFORE
    yield "first fifth lost", set(), rows[BEFORE + T // 5 :]
    yield "second half lost", set(), rows[: BEFORE + T // 2]


def judged(w: Workspace, at: set[str], findings: Sequence[Finding]) -> str:
    """Return the class of what was found in a log."""
    names = {*w.base_model.states, *w.base_model.inputs}
    blamed = names & {name for one in findings if one.code in FAULTS for name in one.about}
    if any(one.code in OTHERS for one in findings):
        return "wrong"
    if blamed - at and not (at and at <= blamed and len(blamed) <= len(at) + 1):
        return "wrong"
    if blamed & at:
        return "told"
    return "unsaid" if any(one.weight is not Weight.NOTE for one in findings) else "stored"


def study(folder: Path, room: Path) -> Counter[str]:
    """Ingest a workspace's last run with each fault; print what was said, and count."""
    w = Workspace(folder)
    runs = [one for one in w.task_trials() if one.candidate and one.steps >= w.task.horizon]
    trial = interpolate_gaps(runs[-1]).trial
    names, rows = columns(w, trial)
    base = room / "base"
    shutil.copytree(folder, base)
    Workspace(base).discard(trial.id)
    for later in (one for one in w.candidate_ids() if one > trial.candidate):
        Workspace(base).candidate_path(later).unlink()
    kinds = [("state", n) for n in trial.state_names] + [("input", n) for n in trial.input_names]
    config = base / "grounded.toml"
    text = re.split(r"(?m)^\[(?:log|estimate)\b", config.read_text())[0]
    text += "".join(f'\n[log.{kind}.{n}]\npath = "/csv.{n}"\n' for kind, n in kinds)
    config.write_text(text)
    found: Counter[str] = Counter()
    for name, at, changed in faults(w, names, rows):
        copy, log = room / "copy", room / "log.csv"
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(base, copy)
        np.savetxt(log, changed, "%.9g", ",", header=",".join(names), comments="")
        try:
            findings = Workspace(copy).ingest(log, candidate=None).findings
        except GroundedError as error:
            findings = (error.finding or Finding("log.reading", weight=Weight.REFUSE),)
        kind = judged(w, at, findings)
        found[kind] += 1
        told = ", ".join(f"{one.code} {' '.join(one.about)}" for one in findings)
        print(f"{kind:7} {name:24} {told}", flush=True)
    print(f"{folder.name}: {dict(found)}\n", flush=True)
    return found


def main() -> None:
    """Study the workspaces named on the command line."""
    total: Counter[str] = Counter()
    for folder in map(Path, sys.argv[1:]):
        with tempfile.TemporaryDirectory() as room:
            total += study(folder, Path(room))
    print(dict(total))


if __name__ == "__main__":
    main()
