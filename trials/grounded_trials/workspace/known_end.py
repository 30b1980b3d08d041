"""Remembers how a search ended, so that the end is not planned again by every command.

Whether a step is worth a trial takes as long to find as a candidate does, up to half a minute of
CPU. The end follows from the files alone, so it is kept in the cache of compiled models, one file a
workspace, with a digest of all that it was made from. The workspace stores no end.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import grounded
from grounded.compile.run.jit import store, stored
from grounded.errors import NextCommand
from grounded.search.planner import model_fingerprint
from grounded.search.standing import Standing
from grounded_trials.workspace.folder import Contents, Folder

KIND = ".ended"
SAID = ("phase", "sentence", "ending", "doubt", "missed")


def known_end(workspace: Folder, contents: Contents, now: Standing) -> Standing | None:
    """Return the end of a search that was planned before; None if it goes on or is not known.

    Args:
        workspace: the workspace.
        contents: its contents.
        now: the standing, which asks for a candidate.
    """
    found = stored(_place(workspace), KIND)
    if found is None:
        return None
    said = json.loads(found)
    if said["of"] != _digest(workspace, contents):
        return None
    verb, *arguments = said["then"] or [""]
    then = NextCommand(verb, tuple(arguments)) if verb else None
    return replace(now, step=None, then=then, **{name: said[name] for name in SAID})


def remember_end(workspace: Folder, contents: Contents, ended: Standing) -> None:
    """Keep the end of a search, unless it goes on or a candidate was refused, with its reasons."""
    if ended.phase not in ("converged", "stopped") or ended.ending == "not allowed":
        return
    then = ended.then and [ended.then.verb, *ended.then.arguments]
    said = {name: getattr(ended, name) for name in SAID}
    document = {"of": _digest(workspace, contents), "then": then, **said}
    store(_place(workspace), json.dumps(document).encode(), KIND)


def _place(workspace: Folder) -> str:
    return hashlib.sha256(str(workspace.folder.resolve()).encode()).hexdigest()


def _digest(workspace: Folder, contents: Contents) -> str:
    """Return a digest of all that the end of a search follows from, with the version of the code.

    A stored trial's name has a hash of its contents.
    """
    trials = [(one.stored.path.name, one.trial.candidate) for one in contents.trials]
    models = [model_fingerprint(task) for task in (workspace.planner.task, workspace.planner.plan)]
    digest = hashlib.sha256(repr((_version(), workspace.task.hash, models, trials)).encode())
    files = [workspace.config.file, *_model_file(workspace)]
    files += [workspace.candidate_path(one.id) for one in contents.candidates]
    for path in files:
        data = path.read_bytes() if path.is_file() else b""
        digest.update(repr((path.name, len(data))).encode() + data)
    return digest.hexdigest()


def _model_file(workspace: Folder) -> list[Path]:
    file = workspace.config.model.file
    return [workspace.folder / file] if file else []


@cache
def _version() -> tuple[str, int]:
    """Return the version, and when the method's code last changed [ns]."""
    code = Path(grounded.__file__).parent.rglob("*.py")
    return grounded.__version__, max((path.stat().st_mtime_ns for path in code), default=0)
