"""Compiled kernels on disk, in the user's cache folder.

One file a kernel: a header, the SHA-256 of the code, the code. A file that is short, damaged or
of another format is not used and is replaced. Writers put a whole file under a temporary name and
rename it, so that any number of processes may share the folder; beyond MAX_BYTES the files that
were used longest ago go. No cache (a read-only home) means compiling again, never a failure.

GROUNDED_CACHE names another folder; empty, it switches the cache off.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
from pathlib import Path

MAGIC = b"grounded kernel 1\n"
MAX_BYTES = 64 * 2**20


def folder() -> Path | None:
    """Where kernels are kept; None when the cache is off."""
    chosen = os.environ.get("GROUNDED_CACHE")
    if chosen is not None:
        return Path(chosen) if chosen else None
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        xdg = os.environ.get("XDG_CACHE_HOME", "")
        base = Path(xdg) if xdg.startswith("/") else Path.home() / ".cache"
    return base / "grounded"


def read(digest: str) -> bytes | None:
    """The code stored under a digest, or None when there is none that can be trusted."""
    try:
        home = folder()
        if home is None:
            return None
        path = home / f"{digest}.kernel"
        data = path.read_bytes()
        head, check, code = (
            data[: len(MAGIC)],
            data[len(MAGIC) : len(MAGIC) + 32],
            data[len(MAGIC) + 32 :],
        )
        if head != MAGIC or check != _check(digest, code):
            return None
        with contextlib.suppress(OSError):
            os.utime(path)  # used now
        return code
    except (OSError, RuntimeError):
        return None


def write(digest: str, code: bytes) -> None:
    """Stores code, atomically; silently does nothing where it can't."""
    import tempfile  # only a cold process needs it

    try:
        home = folder()
        if home is None:
            return
        home.mkdir(parents=True, exist_ok=True, mode=0o700)
        handle, temporary = tempfile.mkstemp(dir=home, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(MAGIC + _check(digest, code) + code)
            Path(temporary).replace(home / f"{digest}.kernel")
        except BaseException:
            with contextlib.suppress(OSError):
                Path(temporary).unlink()
            raise
        _prune(home)
    except (OSError, RuntimeError):
        return


def _check(digest: str, code: bytes) -> bytes:
    """Binds the code to its name: a file under another's name is foreign."""
    return hashlib.sha256(digest.encode() + code).digest()


def _prune(home: Path) -> None:
    """Removes the files that were used longest ago until MAX_BYTES are left."""
    entries = []
    for path in home.glob("*.kernel"):
        with contextlib.suppress(OSError):
            status = path.stat()
            entries.append((status.st_mtime, status.st_size, path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= MAX_BYTES:
            break
        with contextlib.suppress(OSError):
            path.unlink()
            total -= size
