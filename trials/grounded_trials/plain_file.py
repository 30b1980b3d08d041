"""Opens files that somebody else may have put there: regular files up to a size limit.

Reading a pipe would block and a device has no end, so both are refused at once.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from grounded.errors import GroundedError, type_of

# What a system lacks does no harm there: Windows has no pipes in its folders.
BINARY = getattr(os, "O_BINARY", 0)
PLAIN = BINARY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0)
NO_LINKS = getattr(os, "O_NOFOLLOW", 0)


def open_file(path: Path, *, follow: bool = True) -> BinaryIO:
    """Open a regular file for reading, without blocking.

    Args:
        path: the file.
        follow: whether symbolic links are followed; False refuses them.

    Raises:
        GroundedError: if it is a pipe, a device, a socket, or a link that must not be followed.
        OSError: as `open`.
    """
    if not follow and path.is_symlink():
        raise GroundedError(f"{path} is a link, expected a regular file: links are not followed")
    descriptor = os.open(path, os.O_RDONLY | PLAIN | (0 if follow else NO_LINKS))
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(21, "Is a directory", str(path))
        if not stat.S_ISREG(mode):
            what = "a pipe" if stat.S_ISFIFO(mode) else "a device"
            raise GroundedError(f"{path} is {what}, not a file: save its contents to a file first")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, limit: int, *, follow: bool = True) -> bytes:
    """Return the bytes of a regular file; for `follow` see `open_file`.

    Raises:
        GroundedError: if it is missing, unreadable, or larger than `limit` bytes.
    """
    try:
        with open_file(path, follow=follow) as stream:
            data = stream.read(limit + 1)
    except FileNotFoundError:
        raise GroundedError(f"{path} does not exist") from None
    except OSError as error:
        raise GroundedError(f"{path} can't be read: {error.strerror}") from None
    if len(data) > limit:
        raise GroundedError(f"{path} is larger than {limit} bytes, the limit for such a file")
    return data


def path_of(given: object) -> Path:
    """Return the path of a file that the user named.

    Raises:
        GroundedError: if it is not a text or a path.
    """
    if not isinstance(given, str | Path):
        raise GroundedError(f"expected the path of a file, got a {type_of(given)}")
    return Path(given)
