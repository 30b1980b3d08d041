"""Writes and reads candidate files: the policy that a robot runs and its predicted run.

The format is described in this folder's `__init__`. The checksums of the file format detect flipped
bits; `sha256` in the metadata detects a file that was rewritten with other contents.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from grounded.checks import of_shape, refused, wrong
from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded.onboard import WIDTH, fault
from grounded.policy import Policy
from grounded_trials.formats.protobuf import encode_doubles, encode_lists
from grounded_trials.store.own_files import (
    CANDIDATE,
    Meta,
    Units,
    read_own,
    stated,
    with_units,
)


def encoded_candidate(
    policy: Policy,
    predicted_states: Array,
    predicted_inputs: Array,
    meta: Meta,
    *,
    state_units: Units | None = None,
    input_units: Units | None = None,
) -> tuple[bytes, dict[str, str]]:
    """Return a candidate as the bytes of a file, and the metadata that `read_candidate` returns.

    Equal arguments give equal bytes. The prediction has states (H+1, n) and inputs (H, m); `meta`
    holds the entries besides the reserved ones; units are "1" where missing.
    """
    _refuse_faulty(policy)
    H, n, m = policy.horizon, len(policy.state_names), len(policy.input_names)
    states, inputs = np.asarray(predicted_states, float), np.asarray(predicted_inputs, float)
    for array, shape in ((states, (H + 1, n)), (inputs, (H, m))):
        of_shape("prediction", array, shape)
    about = {
        "low": [None if v == -np.inf else v for v in policy.low.tolist()],
        "high": [None if v == np.inf else v for v in policy.high.tolist()],
        "past": policy.past.tolist(),
        "depths": list(policy.depths),
        "angles": [bool(a) for a in policy.angles],
        "z": list(policy.z_names),
    }
    table = stated(
        CANDIDATE,
        policy.dt,
        with_units(policy.state_names, state_units),
        with_units(policy.input_names, input_units),
        meta,
        steps=str(H),
        policy=json.dumps(about),
    )
    table["sha256"] = _hash(table, [*_controls(policy), states, inputs])
    times = np.rint(np.arange(H + 1) * policy.dt * 1e9).astype(np.int64)
    from grounded_trials.formats.mcap_writer import McapWriter

    stream = io.BytesIO()
    log = McapWriter(stream)
    log.metadata("grounded", table)
    log.attachment("about", "text/plain", _ABOUT)
    lists = ("feedforward", "gain", "reference")
    columns = [
        (log.doubles("/policy", "Policy", lists, repeated=True), encode_lists(_controls(policy))),
        (log.doubles("/predicted_state", "State", policy.state_names), encode_doubles(states)),
        (log.doubles("/predicted_input", "Input", policy.input_names), encode_doubles(inputs)),
    ]
    for k, time in enumerate(times.tolist()):
        for channel, rows in (columns[0], columns[2], columns[1]):
            if k < len(rows):
                log.message(channel, time, rows[k])
    log.finish()
    return stream.getvalue(), table


def read_candidate(
    source: str | Path | bytes, name: str = "candidate"
) -> tuple[Policy, Array, Array, dict[str, str]]:
    """Read a candidate file, by its path, or its bytes and a name for messages.

    Returns the policy, the predicted states (H+1, n) and inputs (H, m), and the metadata. That of
    a file written by 0.1 has no `sha256`, so its contents are not verified.
    """
    own = read_own(source, name, CANDIDATE)
    states, inputs = own.names("states"), own.names("inputs")
    table = own.json("policy", dict)
    n, m = len(states), len(inputs)
    given = own.floats(table.get("depths"), "policy.depths", m)
    if not ((given == np.round(given)) & (given >= 0) & (given <= WIDTH)).all():
        raise own.bad("policy.depths", given.tolist(), must="whole", low=0, high=WIDTH)
    depths = tuple(given.astype(int).tolist())
    nz = n + sum(depths)
    feedforward, gain, reference = own.lists(
        "/policy", {"feedforward": m, "gain": m * nz, "reference": nz}
    )
    H, steps = len(feedforward), own.integer("steps")
    policy = Policy(
        feedforward=feedforward,
        low=own.floats(table.get("low"), "policy.low", m, null=-np.inf),
        high=own.floats(table.get("high"), "policy.high", m, null=np.inf),
        dt=own.number("dt"),
        state_names=tuple(states),
        input_names=tuple(inputs),
        depths=depths,
        angles=tuple(map(bool, own.floats(table.get("angles"), "policy.angles", n))),
        past=own.floats(table.get("past"), "policy.past", m),
        gain=gain.reshape(-1, m, nz) if gain.size else None,
        reference=reference if reference.size else None,
    )
    _refuse_faulty(policy, own.name)
    x, u = own.doubles("/predicted_state", states), own.doubles("/predicted_input", inputs)
    if (len(x), H, len(u)) != (steps + 1, steps, steps):
        sizes, wants = (H, len(x), len(u)), (steps, steps + 1, steps)
        raise wrong(f"{own.name}: policy, states and inputs", sizes, shape=str(wants))
    if own.meta.get("sha256") not in (None, _hash(own.meta, [*_controls(policy), x, u])):
        raise refused("file.changed", own.name, what="candidate", then=NextCommand("propose"))
    return policy, x, u, own.meta


def read_policy(path: str | Path) -> tuple[Policy, str]:
    """Read a candidate's policy and task hash; `grounded.policy.load` uses it for .mcap files."""
    policy, _, _, meta = read_candidate(path, str(path))
    return policy, meta.get("task", "")


_ABOUT = b"""A candidate policy of grounded. At step k (t = k dt) send
  u = clip(feedforward + gain (z - reference), low, high),   gain: m rows of nz numbers,
z = the measured states, then for each input its depths[j] last sent values, newest first.
Differences of states marked in `angles` are wrapped to [-pi, pi]. Names, units, limits: see the
metadata record `grounded`.
"""


def _controls(policy: Policy) -> list[Array]:
    """Return feed-forward, gain and reference by step; the last two are empty without feedback."""
    H, none = policy.horizon, np.zeros((policy.horizon, 0))
    gain = none if policy.gain is None else policy.gain.reshape(H, -1)
    return [policy.feedforward, gain, none if policy.reference is None else policy.reference]


def _hash(table: Meta, arrays: Iterable[Array]) -> str:
    """Return the SHA-256 of the metadata (without `sha256`) and all numbers."""
    known = dict(table)
    known.pop("sha256", None)
    digest = hashlib.sha256(json.dumps(known, sort_keys=True).encode())
    for array in arrays:
        digest.update(repr(array.shape).encode())
        digest.update(np.ascontiguousarray(array + 0.0, dtype="<f8").reshape(-1).data)
    return digest.hexdigest()


def _refuse_faulty(policy: Policy, name: str = "candidate") -> None:
    if wrong := fault(policy):
        raise refused("plan.refused", name, why=wrong)
