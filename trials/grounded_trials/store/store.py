"""The store: an append-only folder of files that are identified by the hash of their contents.

A file is named like t0007-3f9a0c2d51b8e644.mcap: its number in order of arrival, and the first 16
hex digits of the SHA-256 of its bytes. There is no other record, so copying the folder keeps the
order. (Two files with the same number, from two folders that were merged, are ordered by their
hashes.) The hash is checked at every read.

A file is copied to a temporary name in the same folder, synced and renamed, and the folder is
synced, before it is acknowledged. A lock keeps other processes out. A killed process may leave a
temporary file, which the next process removes.

`documents.py` handles JSON files (notes, diagnoses).
"""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from grounded.checks import refused, unknown, wrong
from grounded.errors import GroundedError
from grounded.result import Document
from grounded_trials.plain_file import BINARY, open_file, read_file, unreadable, unwritable

DIGITS = 16  # hex digits of the hash in a file name
_NAME = re.compile(r"^([a-z]+)(\d{4,})-([0-9a-f]{16})(\.\w+)$")
_TEMPORARY = re.compile(r"-([0-9a-f]{16}|\d+)\.tmp$")  # process ids: of 0.2
MENDS = {errno.ENOSPC: "space", errno.EDQUOT: "space"}
MENDS |= dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "permission")
POLL_S = 0.01  # [s] between two attempts to lock a folder that another process has locked
OLD_S = 3600.0  # [s] age at which a temporary file counts as abandoned


@dataclass(frozen=True)
class Stored:
    """A file of the store."""

    path: Path
    number: int
    digest: str  # the first 16 hex digits of its SHA-256, from its name

    @property
    def id(self) -> str:
        """Its short name, such as t0007."""
        return self.path.name.split("-")[0]


@dataclass(frozen=True)
class Added(Stored):
    """The result of adding a file to the store."""

    sha256: str
    known: bool  # it was already in the store


@dataclass(frozen=True, eq=False)
class Lost(Document):
    """A file that is missing or damaged, with the reason."""

    file: str
    reason: str


class Store:
    """A folder of content-addressed files; `prefix` is the letter of their short names."""

    def __init__(self, folder: str | Path, prefix: str = "t") -> None:
        self.folder, self.prefix = Path(folder), prefix
        self._listed: tuple[list[str], tuple[Stored, ...]] = ([], ())  # the last listing

    def list(self) -> tuple[Stored, ...]:
        """Return the files in order of arrival; reads only the folder, no file."""
        try:
            names = os.listdir(self.folder)  # noqa: PTH208 (many times faster)
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise unreadable(self.folder, error) from None
        if names != self._listed[0]:
            found = [
                Stored(self.folder / name, int(match[2]), match[3])
                for name in names
                if (match := _NAME.match(name)) and match[1] == self.prefix
            ]
            self._listed = names, tuple(sorted(found, key=attrgetter("number", "digest")))
        return self._listed[1]

    def holds(self, sha256: str) -> bool:
        """Return whether a file with this hash is stored."""
        return any(entry.digest == sha256[:DIGITS] for entry in self.list())

    def find(self, key: str) -> Stored:
        """Return the file whose short name or name is `key`."""
        hits = self.matching(key)
        if len(hits) == 1:
            return hits[0]
        if not hits:
            raise unknown("file", key, [entry.id for entry in self.list()], str(self.folder))
        names = ", ".join(s.path.name for s in hits)
        raise wrong(f"'{key}'", got=names, must="unique")

    def matching(self, key: str) -> tuple[Stored, ...]:
        """Return the files that `find` chooses from."""
        return tuple(s for s in self.list() if key in (s.id, s.path.name))

    def read(self, key: str | Stored) -> bytes:
        """Return the contents of a file, checked against its hash."""
        entry = key if isinstance(key, Stored) else self.find(key)
        data = read_file(entry.path, follow=False)
        if hashlib.sha256(data).hexdigest()[:DIGITS] != entry.digest:
            raise refused("file.changed", entry.path, what="hash")
        return data

    def add(self, data: bytes, suffix: str = ".mcap", *, again: bool = False) -> Added:
        """Add a file; equal contents are stored once, unless `again`: a run may repeat another.

        On return, the contents are synced to disk. If the stored file with this hash is damaged, it
        is replaced; the damaged file is kept as `NAME.damaged`.
        """
        digest = hashlib.sha256(data).hexdigest()
        with self.locked():
            try:
                sweep(self.folder, age_s=0.0)  # the lock excludes running processes
                entries = self.list()
                same = None
                for entry in reversed(entries):
                    same = entry if entry.digest == digest[:DIGITS] else same
                whole = same is not None and hash_file(same.path) == digest
                if same is None or (again and whole):
                    number = entries[-1].number + 1 if entries else 1
                    name = f"{self.prefix}{number:04d}-{digest[:DIGITS]}{suffix}"
                    same = Stored(self.folder / name, number, digest[:DIGITS])
                elif whole:
                    return Added(**vars(same), sha256=digest, known=True)
                else:  # a copy, so that the damaged file stays if the disk is full
                    aside = same.path.with_name(same.path.name + ".damaged")
                    aside.unlink(missing_ok=True)
                    shutil.copyfile(same.path, aside)
                _place(data, same.path, mode=0o444)
            except OSError as error:
                raise self._unwritable(error) from None
        return Added(**vars(same), sha256=digest, known=False)

    @contextmanager
    def adding(self, data: bytes, suffix: str = ".mcap", *, again: bool = False) -> Iterator[Added]:
        """Add a file as `add` does, and remove it again if the `with` body raises.

        It is not removed if another file was added after it, so that numbers have no gaps.
        """
        added = self.add(data, suffix, again=again)
        try:
            yield added
        except BaseException:
            with self.locked(), suppress(OSError, GroundedError):
                if not added.known and self.list()[-1:] == (self.find(added.path.name),):
                    added.path.unlink()
                    sync_folder(self.folder)
            raise

    def verify(self) -> tuple[Lost, ...]:
        """Read every file, and return the damaged ones."""
        damaged = []
        for entry in self.list():
            try:
                self.read(entry)
            except GroundedError as error:
                damaged.append(Lost(str(entry.path), str(error)))
        return tuple(damaged)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the store, so that no other process adds a file meanwhile."""
        try:
            from filelock import FileLock, has_fcntl

            self.folder.mkdir(parents=True, exist_ok=True)
            if os.name == "posix" and not has_fcntl:  # else any file would count as a lock
                raise NotImplementedError
            # without a fallback to lock files, which a killed process would leave behind
            lock = FileLock(self.folder / ".lock", mode=0o644, fallback_to_soft=False)
            lock.acquire(poll_interval=POLL_S)
        except (ImportError, NotImplementedError, OSError) as error:
            if isinstance(error, OSError) and error.errno not in (errno.ENOSYS, errno.ENOTSUP):
                raise self._unwritable(error) from None
            raise unwritable(self.folder, error, mend="lock") from None
        try:
            yield
        finally:
            with suppress(OSError):  # nothing was written to it
                lock.release()

    def _unwritable(self, error: OSError) -> GroundedError:
        mend = MENDS.get(error.errno or 0)
        return unwritable(self.folder, error, **({"mend": mend} if mend else {}))


def made_folder(folder: Path) -> Path:
    """Create a folder, with those above it, if it does not exist yet; return it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from None
    return folder


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically: temporary name, sync, rename, sync of the folder."""
    if path.is_dir():
        raise unwritable(path, "folder")
    try:
        sweep(path.parent)
        _place(data, path, mode=0o644)
    except FileNotFoundError:
        raise refused("file.unwritable", path, folder=str(path.parent)) from None
    except OSError as error:
        raise unwritable(path, error) from None


def sweep(folder: Path, age_s: float = OLD_S) -> None:
    """Remove temporary files of killed processes, so long after their last write."""
    with os.scandir(folder) as entries:
        names = [e.name for e in entries if e.name[0] == "." and _TEMPORARY.search(e.name)]
    for name in names:
        with suppress(OSError):
            if (folder / name).lstat().st_mtime <= time.time() - age_s:
                (folder / name).unlink()


def _place(data: bytes, path: Path, mode: int) -> None:
    """Write a file under a hidden name beside it, sync and rename it, and sync the folder.

    The name is not that of the process: processes in two containers may have the same id.
    """
    temporary = path.with_name(f".{path.name}-{os.urandom(8).hex()}.tmp")
    try:
        descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | BINARY, 0o644)
        with os.fdopen(descriptor, "wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        temporary.chmod(mode)
        temporary.replace(path)
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that the names in it are durable; on Windows they are."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file, read in blocks."""
    try:
        with open_file(path) as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise unreadable(path, error) from None
