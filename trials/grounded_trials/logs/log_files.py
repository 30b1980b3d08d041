"""The records of a log's files (`log_paths`), in any supported format.

The format is detected by the first bytes (`FORMATS`), not by the name, in a file compressed with
zstd as well; else it is a text table. Every format is converted to MCAP records, so callers need
not know it.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import BinaryIO, Concatenate, ParamSpec, TypeVar

from grounded.checks import refused
from grounded.errors import GroundedError, needs
from grounded_trials.formats.bags import ZSTD, decompressed
from grounded_trials.formats.lerobot import is_episode
from grounded_trials.formats.mcap_records import MAGIC, Channel, Messages, Record, Rows
from grounded_trials.formats.mcap_walk import mapped, read_records
from grounded_trials.formats.tables import AS_IT_SAYS, Layout, table_records
from grounded_trials.formats.text_tables import SUFFIXES
from grounded_trials.logs.log_paths import (
    CSV,
    EPISODE,
    FORMATS,
    Format,
    empty,
    log_files,
    on_disk,
    open_log,
)
from grounded_trials.plain_file import unreadable
from grounded_trials.within import within

P = ParamSpec("P")
T = TypeVar("T")


def log_records(path: Path, layout: Layout = AS_IT_SAYS) -> Iterator[Record]:
    """Yield the records of one file of any supported format; only in `read_apart`.

    Raises:
        GroundedError: if it can't be read, is damaged, or is not a log.
    """
    if is_episode(path):
        yield from _read_as(EPISODE, path, layout)
        return
    with open_log(path) as stream:
        head = stream.read(16)
        if not head:
            raise empty(path)
        if head.startswith(ZSTD):
            with tempfile.TemporaryDirectory() as room:
                yield from log_records(_expanded(path, stream, Path(room)), layout)
        elif head.startswith(MAGIC[:5]) or path.name.endswith(".mcap"):
            yield from _guarded("MCAP log", path, read_records(mapped(stream), str(path)))
        elif (format := _format_of(path, head)) is not None:
            yield from _read_as(format, path, layout)
        else:
            raise refused("file.no_log", path, begins=repr(head[:8]))


def _format_of(path: Path, head: bytes) -> Format | None:
    """Return the format of a file that is no MCAP log, by its first bytes, else by its name."""
    known = next((one for one in FORMATS if head.startswith(one.begins)), None)
    return CSV if known is None and path.suffix in SUFFIXES else known


def _read_as(format: Format, path: Path, layout: Layout) -> Iterator[Record]:
    _load(format)
    module, function = format.reader.split(".")
    read = getattr(import_module(f"grounded_trials.formats.{module}"), function)

    def records() -> Iterator[Record]:
        if format.writes:
            yield from table_records(read(path, layout), format.writes, path, layout.rate)
        else:
            yield from read(path)

    yield from _guarded(format.kind, path, records())


def _guarded(kind: str, path: Path, records: Iterator[Record]) -> Iterator[Record]:
    """Yield records, their messages decompressed; what a reader raises is told of the file."""
    try:
        for record in records:
            yield decompressed(record) if isinstance(record, Messages) else record
    except GroundedError:
        raise
    except Exception as error:  # a decoder raises whatever a damaged file leads to
        why = f"{type(error).__name__}: {error}"
        raise unreadable(path, why[:500], kind=kind) from error


def _expanded(path: Path, stream: BinaryIO, room: Path) -> Path:
    """Decompress a zstd file into a folder."""
    import zstandard

    stream.seek(0)
    decoder, target = zstandard.ZstdDecompressor(max_window_size=2**27), room / path.stem
    try:
        with target.open("wb") as out:
            decoder.copy_stream(stream, out)
    except (zstandard.ZstdError, OSError) as error:
        raise unreadable(path, str(error), kind="zstd file") from error
    return target


def read_apart(
    paths: str | Path | Sequence[str | Path],
    function: Callable[Concatenate[tuple[Path, ...], P], T],
    *args: P.args,
    **kwargs: P.kwargs,
) -> T:
    """Return function(files, ...) for the files of a log, computed in a child process."""
    files = log_files(paths)
    size = sum(one.stat().st_size for file in files for one in on_disk(file))
    for file in files:  # the memory of a library is then not counted as the file's
        if is_episode(file):
            _load(EPISODE)
        else:
            with open_log(file) as stream:
                _load(_format_of(file, stream.read(16)))
    return within(files[0], size, function, files, *args, **kwargs)


def _load(format: Format | None) -> None:
    if format is not None and format.library:
        needs(format.library, format.extra)


def digest_of(log: Path) -> str:
    """Return the SHA-256 of what is read of an episode, whatever else its files hold."""
    return read_apart(log, _digest)


def _digest(files: tuple[Path, ...]) -> str:
    hasher = hashlib.sha256()
    for record in log_records(files[0]):
        if isinstance(record, Channel):
            hasher.update(record.topic.encode())
        elif isinstance(record, Rows):
            for name, column in {"": record.times, **record.columns}.items():
                hasher.update(name.encode() + column.tobytes())
    return hasher.hexdigest()
