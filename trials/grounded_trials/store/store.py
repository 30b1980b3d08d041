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
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from grounded.checks import refused, unknown, wrong
from grounded.errors import GroundedError
from grounded.result import Document
from grounded_trials.plain_file import BINARY, open_file, unreadable, unwritable

DIGITS = 16  # hex digits of the hash in a file name
_NAME = re.compile(r"^([a-z]+)(\d{4,})-([0-9a-f]{16})(\.\w+)$")
_BLOCK = 2**20
_TEMPORARY = re.compile(r"-([0-9a-f]{16}|\d+)\.tmp$")  # process ids: of 0.2
MENDS = {errno.ENOSPC: "space", errno.EDQUOT: "space"}
MENDS |= dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "permission")
POLL_S = 0.01  # [s] between two attempts to lock a folder that another process has locked
OLD_S = 3600.0  # [s] age at which a temporary file counts as abandoned


@dataclass(frozen=True)
class _Named:
    path: Path

    @property
    def id(self) -> str:
        """Its short name, such as t0007."""
        return self.path.name.split("-")[0]


@dataclass(frozen=True)
class Stored(_Named):
    """A file of the store."""

    number: int
    digest: str  # the first 16 hex digits of its SHA-256, from its name


@dataclass(frozen=True)
class Added(_Named):
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
        self._seen: dict[str, Stored | None] = {}  # parsed file names
        self._listed: tuple[list[str], tuple[Stored, ...]] = ([], ())  # the last listing

    def list(self) -> tuple[Stored, ...]:
        """Return the files in order of arrival; reads only the folder, no file.

        Raises:
            GroundedError: if the folder can't be read.
        """
        try:
            names = os.listdir(self.folder)  # noqa: PTH208 (many times faster)
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise unreadable(self.folder, error) from None
        if names == self._listed[0]:
            return self._listed[1]
        for name in names:
            if name not in self._seen:
                match, self._seen[name] = _NAME.match(name), None
                if match and match[1] == self.prefix:
                    self._seen[name] = Stored(self.folder / name, int(match[2]), match[3])
        found = (entry for name in names if (entry := self._seen[name]) is not None)
        self._listed = names, tuple(sorted(found, key=attrgetter("number", "digest")))
        return self._listed[1]

    def digests(self) -> set[str]:
        """Return the hashes in the names of all files."""
        return {entry.digest for entry in self.list()}

    def find(self, key: str) -> Stored:
        """Return the file whose short name or name is `key`.

        Raises:
            GroundedError: if there is none, or more than one.
        """
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
        """Return the contents of a file, checked against its hash.

        Raises:
            GroundedError: if it does not exist, can't be read, or was changed.
        """
        entry = key if isinstance(key, Stored) else self.find(key)
        try:
            with open_file(entry.path, follow=False) as stream:
                data = stream.read()
        except OSError as error:
            raise unreadable(entry.path, error) from None
        if hashlib.sha256(data).hexdigest()[:DIGITS] != entry.digest:
            raise refused("file.changed", entry.path, what="hash")
        return data

    def add(
        self, source: str | Path | bytes, suffix: str = ".mcap", *, again: bool = False
    ) -> Added:
        """Add a copy of a file, or bytes; equal contents are stored once, unless `again`.

        On return, the contents are synced to disk. If the stored file with this hash is damaged, it
        is replaced by the copy; the damaged file is kept as `NAME.damaged`.

        Args:
            source: the file, or its bytes.
            suffix: suffix of its name in the store.
            again: store equal contents as a new file, for a run that repeats another bit by bit.

        Raises:
            GroundedError: if the source can't be read or the folder can't be written.
        """
        with self.locked():
            try:
                sweep(self.folder, age_s=0.0)  # the lock excludes running processes
                with _temporary(self.folder / self.prefix) as temporary:
                    digest = _copy(source, temporary)
                    return self._place(temporary, digest, suffix, again)
            except OSError as error:
                raise self._unwritable(error) from None

    @contextmanager
    def adding(
        self, source: str | Path | bytes, suffix: str = ".mcap", *, again: bool = False
    ) -> Iterator[Added]:
        """Add a file as `add` does, and remove it again if the `with` body raises.

        It is not removed if another file was added after it, so that numbers have no gaps.

        Args:
            source: see `add`.
            suffix: see `add`.
            again: see `add`.

        Raises:
            GroundedError: see `add`.
        """
        added = self.add(source, suffix, again=again)
        try:
            yield added
        except BaseException:
            with self.locked(), suppress(OSError, GroundedError):
                if not added.known and self.list()[-1:] == (self.find(added.path.name),):
                    added.path.unlink()
                    sync_folder(self.folder)
            raise

    def verify(self) -> tuple[Lost, ...]:
        """Read every file, and return the damaged ones.

        Raises:
            GroundedError: if the folder can't be read.
        """
        damaged = []
        for entry in self.list():
            try:
                self.read(entry)
            except GroundedError as error:
                damaged.append(Lost(str(entry.path), str(error)))
        return tuple(damaged)

    def _place(self, temporary: Path, digest: str, suffix: str, again: bool) -> Added:
        entries = self.list()
        path = next((e.path for e in entries if e.digest == digest[:DIGITS]), None)
        if path is None or (again and hash_file(path) == digest):
            number = entries[-1].number + 1 if entries else 1
            path = self.folder / f"{self.prefix}{number:04d}-{digest[:DIGITS]}{suffix}"
        elif hash_file(path) == digest:
            return Added(path, digest, known=True)
        else:
            path.replace(path.with_name(path.name + ".damaged"))
        temporary.rename(path)
        sync_folder(self.folder)
        return Added(path, digest, known=False)

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Lock the store, so that no other process adds a file meanwhile.

        Raises:
            GroundedError: if the folder can't be written.
        """
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
    """Create a folder, with those above it, if it does not exist yet; return it.

    Raises:
        GroundedError: if it can't be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from None
    return folder


def write_atomically(path: Path, data: bytes) -> None:
    """Write a file atomically: temporary name, sync, rename, sync of the folder.

    Raises:
        GroundedError: if it can't be written.
    """
    if path.is_dir():
        raise unwritable(path, "folder")
    try:
        sweep(path.parent)
        with _temporary(path) as temporary:
            _copy(data, temporary, mode=0o644)
            temporary.replace(path)
        sync_folder(path.parent)
    except FileNotFoundError:
        raise refused("file.unwritable", path, folder=str(path.parent)) from None
    except OSError as error:
        raise unwritable(path, error) from None


def sweep(folder: Path, age_s: float = OLD_S) -> None:
    """Remove temporary files of killed processes, so long after their last write."""
    with os.scandir(folder) as entries:
        names = [e.name for e in entries if e.name[0] == "." and _TEMPORARY.search(e.name)]
    for path in (folder / name for name in names):
        with suppress(OSError):
            if path.lstat().st_mtime <= time.time() - age_s:
                path.unlink()


@contextmanager
def _temporary(path: Path) -> Iterator[Path]:
    """Give a hidden name beside a file; what is left there is removed, now or by a later process.

    It is not named by process id: processes in two containers may have the same id.
    """
    temporary = path.with_name(f".{path.name}-{os.urandom(8).hex()}.tmp")
    try:
        yield temporary
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def sync_folder(folder: Path) -> None:
    """Sync a folder, so that the names in it are durable; on Windows they are."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _copy(source: str | Path | bytes, target: Path, mode: int = 0o444) -> str:
    """Copy to a new file and sync it; return the SHA-256 of the contents."""
    hasher = hashlib.sha256()
    descriptor = os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | BINARY, 0o644)
    with os.fdopen(descriptor, "wb") as out:
        for block in _blocks(source):
            hasher.update(block)
            out.write(block)
        out.flush()
        os.fsync(out.fileno())
    target.chmod(mode)
    return hasher.hexdigest()


def _blocks(source: str | Path | bytes) -> Iterator[bytes]:
    if isinstance(source, bytes):
        yield source
        return
    try:
        with open_file(Path(source)) as stream:
            while block := stream.read(_BLOCK):
                yield block
    except OSError as error:
        raise unreadable(source, error) from None


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file, read in blocks.

    Raises:
        GroundedError: if it can't be read.
    """
    hasher = hashlib.sha256()
    for block in _blocks(path):
        hasher.update(block)
    return hasher.hexdigest()
