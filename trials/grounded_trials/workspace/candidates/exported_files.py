"""Exported candidates as files (csv, json and npz), and the command that runs one.

All three have the same contents. With z = [state, past inputs] (names in `z_names`),

    u_t = clip(feedforward_t + gain_t (z - reference_t), low, high)

for the step t nearest to (time since start) / dt; differences of angles wrap to [-pi, pi].
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.policy import Policy, to_arrays
from grounded_trials.workspace.folder import Folder

LAW = "u_t = clip(feedforward_t + gain_t (z - reference_t), low, high); z = [state, past inputs]"
OPEN_LOOP = "u_t = clip(feedforward_t, low, high)"  # no gain and no reference


def is_export(workspace: Folder, identity: str, path: Path) -> bool:
    """Return whether a file is byte for byte the candidate as exported, or as proposed (mcap)."""
    form = path.suffix.lstrip(".").lower()
    try:
        if form == "mcap":
            data = workspace.candidate_bytes(identity)
        elif form in (known := encoders()):
            made, meta = workspace.candidate(identity)
            data = known[form](made.policy, units_of(workspace), about_of(identity, meta))
        else:
            return False
        return path.stat().st_size == len(data) and path.read_bytes() == data
    except (OSError, GroundedError):
        return False


def encoders() -> dict[str, Callable[[Policy, dict[str, str], dict[str, str]], bytes]]:
    """Return the functions that write a policy, its units and its origin, by format."""
    return {"csv": _csv, "json": _json, "npz": _npz}


def about_of(identity: str, meta: Mapping[str, str]) -> dict[str, str]:
    """Return what a file says of where it comes from."""
    about = {"candidate": identity, "task": meta["task"], "model": meta["model"]}
    return about | {"created_by": "grounded"}


def units_of(workspace: Folder) -> dict[str, str]:
    """Return the units of the states and inputs."""
    model = workspace.base_model
    return {**model.states, **model.inputs}


def _law(policy: Policy) -> str:
    return OPEN_LOOP if policy.gain is None else LAW


def _npz(policy: Policy, units: dict[str, str], about: dict[str, str]) -> bytes:
    stream = io.BytesIO()
    texts = {"law": _law(policy), "units": json.dumps(units), "time_unit": "s", **about}
    np.savez(stream, **to_arrays(policy, **texts))
    return stream.getvalue()


def _json(policy: Policy, units: dict[str, str], about: dict[str, str]) -> bytes:
    document: dict[str, Any] = {
        "format": "grounded-policy-1",
        **about,
        "law": _law(policy),
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
    """Format one row per control step; lines that start with # have the law, units and limits."""
    stream = io.StringIO()
    stream.write("# format: grounded-policy-1\n")
    for key, value in {**about, "law": _law(policy), "dt [s]": repr(policy.dt)}.items():
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


def to_run(workspace: Folder, candidate: str, *named: str) -> NextCommand:
    """Return the command that runs a candidate: `run`, or `export` and then `next` if run by hand.

    It counts as exported if a file with the contents of its export is in the workspace or in the
    current folder; the name of a file alone proves nothing.

    Args:
        workspace: the workspace.
        candidate: the candidate's id.
        named: the name to use in the command; () for the outstanding candidate.
    """
    if workspace.config.system.reachable:
        return NextCommand("run", named)

    name = named[0] if named else candidate
    files = (path for at in (workspace.folder, Path()) for path in at.glob(f"{name}.*"))
    if any(is_export(workspace, candidate, path) for path in files):
        return NextCommand("next", ("LOG", "--candidate", candidate) if named else ("LOG",))
    return NextCommand("export", (name, "--runner"))
