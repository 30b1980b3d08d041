"""Tell what [log] reads in another way than when trials were ingested.

A trial keeps its numbers when [log] is changed. So what a diagnosis found in it may be due to what
was corrected there since: its log has to be ingested again first.
"""

from __future__ import annotations

import json
import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded_trials.logs.log_files import digest_of, log_files
from grounded_trials.logs.log_table import LogMapping
from grounded_trials.store.store import hash_file
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import READ_BY, StoredTrial, sha256

if TYPE_CHECKING:
    from grounded.diagnosis.report import Diagnosis

PLAIN = {"scale": 1.0, "offset": 0.0, "delay_s": 0.0}  # keys of a signal that is read unchanged


def read_by(mapping: LogMapping) -> dict[str, str]:
    """Return the metadata of a trial with how [log] reads each signal, without keys as in PLAIN."""
    found = {}
    for name, spec in {**mapping.states, **mapping.inputs}.items():
        keys = {key: float(getattr(spec, key)) for key in PLAIN}
        found[name] = {"path": spec.path} | {k: v for k, v in keys.items() if v != PLAIN[k]}
    return {READ_BY: json.dumps(found)}


def paths_of(meta: Mapping[str, str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the columns from which [log] read some signals of a trial; () if it does not say."""
    try:
        before = json.loads(meta[READ_BY])
        return tuple(str(before[name]["path"]) for name in names)
    except (KeyError, ValueError, TypeError, RecursionError):
        return ()


def read_otherwise(
    meta: Mapping[str, str], mapping: LogMapping | None, corrected: Collection[tuple[str, str]] = ()
) -> tuple[str, ...]:
    """Return the signals of a trial that [log] reads in another way now.

    Args:
        meta: the trial's metadata, which is not trusted.
        mapping: the present [log].
        corrected: signals with a key of theirs that may differ.
    """
    if mapping is None or READ_BY not in meta:
        return ()
    try:
        before = {str(name): dict(keys) for name, keys in json.loads(meta[READ_BY]).items()}
        was = {n: {k: float(own.get(k, v)) for k, v in PLAIN.items()} for n, own in before.items()}
    except (ValueError, TypeError, AttributeError, RecursionError):
        return ()
    found = []
    for name, spec in {**mapping.states, **mapping.inputs}.items():
        if name not in before:
            continue
        elsewhere = before[name].get("path", spec.path) != spec.path
        keys = [key for key in PLAIN if (name, key) not in corrected]
        if elsewhere or not all(np.isclose(was[name][key], getattr(spec, key)) for key in keys):
            found.append(name)
    return tuple(found)


def changed_since(
    workspace: Folder, diagnosis: Diagnosis, usable: Collection[str]
) -> tuple[str, ...]:
    """Return the signals that [log] reads otherwise than it did for a diagnosis, else ().

    What the diagnosis corrected itself may have been written into [log] since. Once there is a
    trial that was read by the present [log], the others were left as they are on purpose.
    """
    made = diagnosis.made
    if made is None or not workspace.config.log.names():
        return ()
    mapping = workspace.log_mapping
    corrected = {
        (name, key)
        for one in diagnosis.preflight
        for name in one.signal.split("+")
        for key in PLAIN
        if key in one.log
    }
    if any(one.kind == "delay" and one.log for one in diagnosis.preflight):  # maybe of another
        corrected |= {(name, "delay_s") for name in workspace.base_model.state_names}
    found: tuple[str, ...] = ()
    for one in workspace.whole_trials():
        if one.stored.id in usable and READ_BY in one.meta:
            found = read_otherwise(one.meta, mapping, corrected)
            if not found:
                return ()
    return found


def again(
    workspace: Folder, meta: Mapping[str, str], candidate: str, *, waits: bool = False
) -> NextCommand:
    """Return the command that ingests a trial's log again.

    If its candidate waits for a trial, it needs no name: it is recognised, or the log is refused.
    """
    what = ("--candidate", candidate) if candidate else ("--data",)
    return NextCommand("ingest", (_log_of(workspace, meta), *(what if not waits else ())))


def last_again(workspace: Folder, trials: Sequence[StoredTrial]) -> NextCommand | None:
    """Return the command that ingests the last foreign log among some trials again."""
    foreign = [one for one in trials if "source" in one.meta]
    if not foreign:
        return None
    return again(workspace, foreign[-1].meta, foreign[-1].trial.candidate)


def hashed(files: Sequence[Path]) -> str:
    """Return the SHA-256 of a log's file, or of the hashes if it has several files."""
    hashes = [hash_file(file) if file.is_file() else digest_of(file) for file in files]
    return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode())


def _log_of(workspace: Folder, meta: Mapping[str, str]) -> str:
    """Return the path of a trial's log if it is in or beside a folder in use, else LOG."""
    name, home = Path(meta["source"]).name, workspace.folder.resolve()
    for folder in (Path.cwd(), home, home.parent):
        with suppress(GroundedError, OSError, ValueError):  # its name may be none
            if hashed(log_files(folder / name)) == meta.get("source_sha256"):
                return os.path.relpath(folder / name)
    return "LOG"
