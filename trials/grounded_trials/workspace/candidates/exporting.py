"""export: write a candidate for other programs (csv, json, npz), and say how to run one.

All three files have the same contents. With z = [state, past inputs] (names in `z_names`),

    u_t = clip(feedforward_t + gain_t (z - reference_t), low, high)

for the step t nearest to (time since start) / dt; differences of angles wrap to [-pi, pi].
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from grounded import onboard
from grounded.checks import one_of, refused
from grounded.errors import GroundedError
from grounded.findings import Finding
from grounded.policy import Policy, to_arrays
from grounded.result import UNSAID, Document, plain
from grounded.search.standing import Ending
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.candidates.handover import checked_candidate
from grounded_trials.workspace.candidates.search_state import (
    candidate_named,
    known_end,
    standing_in,
)
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import unknown_candidate, unknown_trial
from grounded_trials.workspace.next_step import FORMS

LAW = "u_t = clip(feedforward_t + gain_t (z - reference_t), low, high); z = [state, past inputs]"
OPEN_LOOP = "u_t = clip(feedforward_t, low, high)"  # no gain and no reference


def _said(
    workspace: Folder, policy: Policy, identity: str, meta: Mapping[str, str]
) -> dict[str, Any]:
    """Return what each file says beside the policy's numbers: origin, law and units."""
    about = {"candidate": identity, "task": meta["task"], "model": meta["model"]}
    model, law = workspace.base_model, OPEN_LOOP if policy.gain is None else LAW
    units = {**model.states, **model.inputs}
    return about | {"created_by": "grounded", "law": law, "units": units, "time_unit": "s"}


def _npz(policy: Policy, said: dict[str, Any]) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **to_arrays(policy, **said | {"units": json.dumps(said["units"])}))
    return stream.getvalue()


def _json(policy: Policy, said: dict[str, Any]) -> bytes:
    """Format a table; limits that there are not are null."""
    table = {"format": onboard.FORMAT, **said}
    table |= {k: getattr(policy, k) for k in ("dt", "state_names", "input_names", "z_names")}
    table |= {"angles": _angles(policy)}
    for key in ("low", "high", "past", "feedforward", "gain", "reference"):
        table |= {} if getattr(policy, key) is None else {key: getattr(policy, key)}
    return (json.dumps(plain(table), indent=1, allow_nan=False) + "\n").encode()


def _angles(policy: Policy) -> list[str]:
    return [n for n, a in zip(policy.state_names, policy.angles, strict=True) if a]


def _csv(policy: Policy, said: dict[str, Any]) -> bytes:
    """Format one row per control step; lines that start with # have the law, units and limits."""
    head = {"format": onboard.FORMAT, **said, "dt [s]": repr(policy.dt)}
    head |= {"units": json.dumps(head.pop("units")), "z": ", ".join(policy.z_names)}
    head["differences that wrap to [-pi, pi]"] = ", ".join(_angles(policy)) or "none"
    lines = [*head.items()]
    ends = np.stack([policy.low, policy.high, policy.past], axis=1).tolist()
    for name, (low, high, held) in zip(policy.input_names, ends, strict=True):
        lines.append((name, f"limits [{low!r}, {high!r}], held before the start {held!r}"))
    columns = [policy.feedforward]
    header = ["t", *(f"feedforward.{name}" for name in policy.input_names)]
    if policy.gain is not None and policy.reference is not None:
        columns += [policy.reference, policy.gain.reshape(policy.horizon, -1)]
        header += [f"reference.{z}" for z in policy.z_names]
        header += [f"gain.{u}.{z}" for u in policy.input_names for z in policy.z_names]
    stream = io.StringIO()
    stream.writelines(f"# {key}: {value}\n" for key, value in lines)
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for step, row in enumerate(np.hstack(columns).tolist()):
        writer.writerow([f"{step * policy.dt:.10g}", *map(repr, row)])
    return stream.getvalue().encode()


RUNNER = "grounded_runner.py"


@dataclass(frozen=True, eq=False, repr=False)
class Exported(Document):
    """An exported candidate and its file."""

    candidate: str
    file: Path
    format: str
    runner: Path | None = field(metadata={"brief": True}, default=None)  # the program that runs it
    findings: tuple[Finding, ...] = ()  # reasons against it that were overridden, and notes
    search_ended: bool = False  # whether it is the best candidate of a search that has ended
    named: tuple[str, ...] = field(metadata=UNSAID, default=())  # options of `next` for its log


RUNS = ("csv", "npz")  # formats of a trial


def export_in(
    workspace: Folder,
    candidate: str = "best",
    path: str | Path | None = None,
    *,
    form: str | None = None,
    runner: bool = False,
    anyway: bool = False,
) -> Exported:
    """Export a candidate, or a trial, for other languages.

    Candidates are refused as in `run`, except that one of an earlier task is allowed.

    Args:
        workspace: the workspace.
        candidate: c0003, `best`, or a trial, t0007.
        path: the file; None: named after the candidate, in the current folder.
        form: csv, json or npz; of a trial csv or npz; None: by the file's suffix, else json, npz
            with `runner`, csv of a trial.
        runner: write npz, and beside it the program that runs it on a robot with only numpy.
        anyway: write it although it is void.
    """
    identity = candidate.lower()
    if (trial := identity.startswith("t")) and runner:
        raise unknown_candidate(workspace, identity)
    formats, usual = (RUNS, "csv") if trial else (FORMS, "npz" if runner else "json")
    ending = Path(path).suffix.lstrip(".").lower() if path else ""
    if form or ending:
        one_of("the format" if form else f"the ending of {path}", form or ending, formats)
    form = form or ending or usual
    path = Path(path or f"{identity}.{form}")
    if trial:
        write_atomically(path, _run(workspace, identity, form))
        return Exported(identity, path, form)
    if runner:
        one_of("format of the runner", form, ["npz"])
    now = standing_in(workspace) if identity == "best" else None
    identity = candidate_named(workspace, identity, now)
    handed = checked_candidate(workspace, identity, anyway=anyway, other_task=True, now=now)
    if form == "npz":
        try:
            onboard.check_limits(identity, handed.candidate.policy)
        except ValueError as error:
            raise refused("plan.refused", identity, why=str(error)) from None
    policy, written = handed.candidate.policy, {"csv": _csv, "json": _json, "npz": _npz}[form]
    write_atomically(path, written(policy, _said(workspace, policy, identity, handed.meta)))
    program = path.with_name(RUNNER) if runner else None
    if program is not None:
        write_atomically(program, Path(onboard.__file__).read_bytes())
    now = handed.standing
    waits = now.outstanding is not None and now.outstanding.id == identity
    with suppress(GroundedError):  # another candidate's file is damaged
        now = known_end(workspace, workspace.read(), now) or now
    best = now.incumbent is not None and now.incumbent.candidate.id == identity
    ended = best and now.ending is not Ending.NONE
    told = (*handed.overridden, *handed.findings)
    named = () if waits else ("--candidate", identity)
    return Exported(identity, path, form, program, told, ended, named)


def _run(workspace: Folder, identity: str, form: str) -> bytes:
    """Return a trial as a table with a row for each state."""
    trial = next((one.trial for one in workspace.trials() if one.trial.id == identity), None)
    if trial is None:
        raise unknown_trial(workspace, identity)
    last = np.full((1, trial.inputs.shape[1]), np.nan)  # the last state has no input
    times = trial.dt * np.arange(len(trial.states))[:, None]
    rows = np.hstack([times, trial.states, np.vstack([trial.inputs, last])])
    names, stream = ("t", *trial.state_names, *trial.input_names), io.BytesIO()
    if form == "npz":
        np.savez(stream, **dict(zip(names, rows.T, strict=True)))
    else:
        np.savetxt(stream, rows, fmt="%.10g", delimiter=",", header=",".join(names), comments="")
    return stream.getvalue()
