"""Opens files that somebody else may have put there: regular files up to a size limit.

Reading a pipe would block and a device has no end, so both are refused at once.
"""

from __future__ import annotations

import os
import stat
from io import BufferedReader
from pathlib import Path
from typing import Any

from grounded.checks import of_type, refused
from grounded.errors import GroundedError

# What a system lacks does no harm there: Windows has no pipes in its folders.
BINARY = getattr(os, "O_BINARY", 0)
PLAIN = BINARY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
NO_LINKS = getattr(os, "O_NOFOLLOW", 0)


def open_file(path: Path, *, follow: bool = True) -> BufferedReader:
    """Open a regular file for reading, without blocking; links are followed or refused."""
    if not follow and path.is_symlink():
        raise unreadable(path, "link")
    descriptor = os.open(path, os.O_RDONLY | PLAIN | (0 if follow else NO_LINKS))
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(21, "Is a directory", str(path))
        if not stat.S_ISREG(mode):
            what = "pipe" if stat.S_ISFIFO(mode) else "device"
            raise unreadable(path, what)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, limit: int | None = None, *, follow: bool = True) -> bytes:
    """Return the bytes of a regular file; for `follow` see `open_file`."""
    try:
        with open_file(path, follow=follow) as stream:
            data = stream.read(-1 if limit is None else limit + 1)
    except FileNotFoundError:
        raise refused("file.missing", path) from None
    except OSError as error:
        raise unreadable(path, error) from None
    if limit is not None and len(data) > limit:
        raise unreadable(path, f"> {limit} bytes")
    return data


def path_of(given: object) -> Path:
    """Return the path of a file that the user named."""
    named: Any = given
    return Path(of_type("the path of a file", named, str, Path))


def unreadable(path: object, why: object, **facts: Any) -> GroundedError:
    """Return the error of a file that can't be read, for an error of the system or other reason."""
    return refused("file.unreadable", path, why=_reason(why), **facts)


def unwritable(path: object, why: object, **facts: Any) -> GroundedError:
    """Return the error of a file that can't be written."""
    return refused("file.unwritable", path, why=_reason(why), **facts)


def _reason(why: object) -> str:
    told = getattr(why, "finding", None)
    return str(told.clause if told else getattr(why, "strerror", None) or why)
