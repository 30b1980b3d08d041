"""Opening files that somebody else may have put there: regular ones, of a size that makes sense.

A pipe would be waited for, a device has no end. Either is refused at once, whatever was to be read
from it.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import BinaryIO

from grounded.errors import GroundedError


def open_file(path: Path, *, follow: bool = True) -> BinaryIO:
    """Opens a regular file for reading, without waiting for it.

    Args:
        path: the file.
        follow: it may be a link.

    Raises:
        GroundedError: if it is something else: a pipe, a device, a socket, a link.
        OSError: as `open`.
    """
    if not follow and path.is_symlink():
        raise GroundedError(f"{path} is a link, expected a file: it may lead anywhere")
    links = 0 if follow else os.O_NOFOLLOW
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | links)
    try:
        mode = os.fstat(descriptor).st_mode
        if stat.S_ISDIR(mode):
            raise IsADirectoryError(21, "Is a directory", str(path))
        if not stat.S_ISREG(mode):
            what = "a pipe" if stat.S_ISFIFO(mode) else "a device"
            raise GroundedError(f"{path} is {what}, not a file: save what comes from it first")
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_file(path: Path, limit: int) -> bytes:
    """The bytes of a regular file.

    Raises:
        GroundedError: if it is missing, unreadable, or larger than `limit` bytes.
    """
    try:
        with open_file(path) as stream:
            data = stream.read(limit + 1)
    except FileNotFoundError:
        raise GroundedError(f"{path} does not exist") from None
    except OSError as error:
        raise GroundedError(f"{path} can't be read: {error.strerror}") from None
    if len(data) > limit:
        raise GroundedError(f"{path} is larger than {limit} bytes: expected no such file here")
    return data
