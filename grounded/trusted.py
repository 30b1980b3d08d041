"""Whose code is executed: the user's own, that nobody else can have changed.

Compiled kernels, a workspace's model.py and its `[system] command` run with the user's rights. So
their files, and the folders that they are found in, must belong to the user (or to root) and must
not be writable for anybody else. A group counts as nobody else where it is the user's private one,
as many Linux distributions make it.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from functools import cache
from pathlib import Path

from grounded.errors import GroundedError

TRUST = "GROUNDED_TRUST"  # folders whose code is executed whoever could have written it


def suspicion(path: Path) -> str:
    """Why somebody else may have changed a file or the names in a folder; "" where none can.

    Raises:
        OSError: if it can't be looked at.
    """
    if not hasattr(os, "getuid"):  # Windows: its rights are others
        return ""
    status = path.stat()
    if status.st_uid not in (os.getuid(), 0):
        return f"{path} belongs to another user ({status.st_uid})"
    if status.st_mode & stat.S_IWOTH:
        return f"{path} is writable for everybody"
    if status.st_mode & stat.S_IWGRP and not _private(status.st_gid):
        return f"{path} is writable for its group ({status.st_gid})"
    return ""


def check_own(folder: Path, paths: Iterable[Path]) -> None:
    """Refuses to execute what is in a folder if somebody else may have changed it.

    Args:
        folder: a workspace.
        paths: what is executed or says what is; those that don't exist are left out.

    Raises:
        GroundedError: naming the first of them that isn't the user's own, and the remedy.
    """
    trusted = [Path(name).resolve() for name in os.environ.get(TRUST, "").split(os.pathsep) if name]
    if any(folder.resolve().is_relative_to(known) for known in trusted):
        return
    for path in (folder, *paths):
        try:
            found = suspicion(path)
        except OSError:  # it isn't there, or will not be readable either
            continue
        if found:
            raise GroundedError(
                f"{found}, so what it says may be somebody else's program; nothing of {folder} is "
                f"executed. If it is yours: chown -R $USER and chmod -R go-w, or name the folder "
                f"in {TRUST}"
            )


@cache
def _private(group: int) -> bool:
    """Whether a group is the user's own, of whom no other is a member."""
    import grp
    import pwd

    try:
        user, found = pwd.getpwuid(os.getuid()), grp.getgrgid(group)
    except KeyError:
        return False
    same = user.pw_gid == group and found.gr_name == user.pw_name
    return same and set(found.gr_mem) <= {user.pw_name}
