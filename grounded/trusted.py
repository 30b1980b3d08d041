"""Check that code to be executed can't have been changed by another user.

Compiled kernels, a workspace's model.py and its `[system] command` run with the user's rights. So
these files and their folders must belong to the user (or root) and must not be writable by anybody
else. Write access of the user's private group, which many Linux distributions create, is allowed.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from grounded.errors import GroundedError
from grounded.findings import Finding, found

TRUST = "GROUNDED_TRUST"  # environment variable: folders whose code is executed without this check


def suspicion(path: Path) -> Finding | None:
    """Return why another user may have changed a file or folder; None if none can.

    Raises:
        OSError: if the path can't be read.
    """
    if not hasattr(os, "getuid"):  # Windows has another permission model
        return None
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        return found("file.untrusted", str(path), by="owner", id=str(status.st_uid))
    if status.st_mode & stat.S_IWOTH:
        return found("file.untrusted", str(path), by="all")
    if status.st_mode & stat.S_IWGRP and not _private(status.st_gid):
        return found("file.untrusted", str(path), by="group", id=str(status.st_gid))
    return None


def check_own(folder: Path, paths: Iterable[Path]) -> None:
    """Refuse to execute code in a workspace's folder that another user may have changed.

    Args:
        folder: the workspace.
        paths: files that are executed or that name what is executed; missing files are skipped.

    Raises:
        GroundedError: for the first of them that another user may have changed.
    """
    for name in filter(None, os.environ.get(TRUST, "").split(os.pathsep)):
        if folder.resolve().is_relative_to(Path(name).resolve()):
            return
    for path in (folder, *paths):
        try:
            seen = suspicion(path)
        except OSError:  # missing, or unreadable and hence not executed either
            continue
        if seen:
            raise GroundedError(seen.also(folder=str(folder), trust=TRUST))


@cache
def _private(group: int) -> bool:
    """Return whether a group is the user's private group, without other members."""
    import grp
    import pwd

    try:
        user, found = pwd.getpwuid(os.getuid()), grp.getgrgid(group)
    except KeyError:
        return False
    same = user.pw_gid == group and found.gr_name == user.pw_name
    return same and set(found.gr_mem) <= {user.pw_name}
