"""A candidate for other languages: csv, json or npz, with its units and time base inside.

All three say the same. With z = [state, past inputs] (names in `z_names`),

    u_t = clip(feedforward_t + gain_t (z - reference_t), low, high)

for the step t nearest to (time since start) / dt; differences of angles wrap to [-pi, pi].

Every byte that a workspace keeps, checked: trials by hash, candidates by their own checksums.
"""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError
from grounded.policy import Policy, to_arrays
from grounded_trials.store.candidate_file import read_candidate
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.folder import Workspace
from grounded_trials.workspace.proposing import candidate_named

LAW = "u_t = clip(feedforward_t + gain_t (z - reference_t), low, high); z = [state, past inputs]"


def export_candidate(workspace: Workspace, identity: str, form: str, path: Path) -> str:
    """Writes a candidate; returns its id ("best" is resolved).

    Raises:
        GroundedError: for an unknown candidate, or a place that can't be written.
    """
    identity = candidate_named(workspace, identity)
    candidate, meta = workspace.candidate(identity)
    about = {"candidate": identity, "task": meta["task"], "model": meta["model"]}
    about["created_by"] = "grounded"
    encode = {"csv": _csv, "json": _json, "npz": _npz}[form]
    write_atomically(path, encode(candidate.policy, _units(workspace), about))
    return identity


def _units(workspace: Workspace) -> dict[str, str]:
    model = workspace.base_model
    return {**model.states, **model.inputs}


def _npz(policy: Policy, units: dict[str, str], about: dict[str, str]) -> bytes:
    stream = io.BytesIO()
    texts = {"law": LAW, "units": json.dumps(units), "time_unit": "s", **about}
    np.savez(stream, **to_arrays(policy, **texts))
    return stream.getvalue()


def _json(policy: Policy, units: dict[str, str], about: dict[str, str]) -> bytes:
    document: dict[str, Any] = {
        "format": "grounded-policy-1",
        **about,
        "law": LAW,
        "dt": policy.dt,
        "time_unit": "s",
        "units": units,
        "state_names": policy.state_names,
        "input_names": policy.input_names,
        "z_names": policy.z_names,
        "angles": [n for n, a in zip(policy.state_names, policy.angles, strict=True) if a],
        "low": _limits(policy.low),
        "high": _limits(policy.high),
        "past": policy.past.tolist(),
        "feedforward": policy.feedforward.tolist(),
    }
    if policy.gain is not None and policy.reference is not None:
        document |= {"gain": policy.gain.tolist(), "reference": policy.reference.tolist()}
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def _limits(values: np.ndarray) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _csv(policy: Policy, units: dict[str, str], about: dict[str, str]) -> bytes:
    """A row a control step; lines that start with # say what a reader must know."""
    stream = io.StringIO()
    stream.write("# format: grounded-policy-1\n")
    for key, value in {**about, "law": LAW, "dt [s]": repr(policy.dt)}.items():
        stream.write(f"# {key}: {value}\n")
    stream.write(f"# units: {json.dumps(units)}\n")
    stream.write(f"# z: {', '.join(policy.z_names)}\n")
    angles = [n for n, a in zip(policy.state_names, policy.angles, strict=True) if a]
    stream.write(f"# differences that wrap to [-pi, pi]: {', '.join(angles) or 'none'}\n")
    for name, low, high, held in zip(
        policy.input_names, policy.low, policy.high, policy.past, strict=True
    ):
        span = f"[{float(low)!r}, {float(high)!r}]"
        stream.write(f"# {name}: limits {span}, held before the start {float(held)!r}\n")
    columns = [policy.feedforward]
    header = ["t", *(f"feedforward.{name}" for name in policy.input_names)]
    if policy.gain is not None and policy.reference is not None:
        columns += [policy.reference, policy.gain.reshape(policy.horizon, -1)]
        header += [f"reference.{z}" for z in policy.z_names]
        header += [f"gain.{u}.{z}" for u in policy.input_names for z in policy.z_names]
    values = np.hstack(columns)
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for step, row in enumerate(values):
        writer.writerow([f"{step * policy.dt:.10g}", *(repr(float(v)) for v in row)])
    return stream.getvalue().encode()


def damaged_files(workspace: Workspace) -> tuple[int, list[tuple[str, str]]]:
    """How many files were checked, and (file, reason) for each that is not what it was."""
    damaged = [(str(d.path), d.reason) for d in workspace.store.verify()]
    candidates = sorted((workspace.folder / "candidates").glob("*.mcap"))
    for path in candidates:
        try:
            read_candidate(path)
        except GroundedError as error:
            damaged.append((str(path), str(error)))
    return len(workspace.store.list()) + len(candidates), damaged
