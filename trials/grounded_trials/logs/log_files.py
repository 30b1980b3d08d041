"""The files of a log, and the records of each, in any supported format.

A log is a file, several files in order, or a bag's folder with split files. The format is detected
by the first bytes, not by the name: MCAP, ROS 2 SQLite, ROS 1, NumPy, PX4, any of them compressed
with zstd, else a text table. Every format is converted to MCAP records, so callers need not know
it.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO, Concatenate, ParamSpec, TypeVar
from zipfile import BadZipFile, ZipFile

from grounded.errors import GroundedError
from grounded.findings import found
from grounded_trials.formats.mcap_records import Messages, Metadata, Record
from grounded_trials.formats.mcap_walk import MAGIC, read_records
from grounded_trials.plain_file import open_file, read_file
from grounded_trials.within import within

P = ParamSpec("P")
T = TypeVar("T")
BAGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")  # files of a bag's folder
KINDS = (*BAGS, ".bag", ".csv", ".npz", ".ulg")
NEWEST = 3  # most logs named in place of one that does not exist
LISTING_LIMIT = 2**24  # [bytes] of a metadata.yaml
_ZSTD = b"\x28\xb5\x2f\xfd"
_LISTED = re.compile(
    r"^[ \t]*-[ \t]+(?:path:[ \t]*)?[\"']?([^\"'\s#]+\.(?:mcap|db3)(?:\.zstd)?)[\"']?[ \t\r]*$",
    re.MULTILINE,
)
_NO_LOG = re.compile(r"c\d{4,}\.\w+|target\.csv")  # an exported candidate, or a target
_DIGITS = re.compile(r"(\d+)")


def log_files(paths: str | Path | Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the files of a log in order.

    Args:
        paths: a file, files in order, or the folder of a bag. A folder's metadata.yaml lists its
            files in order; without it, all *.mcap, else *.db3, sorted by the numbers in their
            names.

    Raises:
        GroundedError: if a file is missing, or a folder has none.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    files: list[Path] = []
    for path in map(Path, given):
        files.extend(_bag(path) if path.is_dir() else [path])
    for path in files:
        if not path.exists():
            raise _missing(path)
    if not files:
        raise GroundedError(found("file.missing", "a log"))
    return tuple(files)


def _bag(folder: Path) -> list[Path]:
    listing = folder / "metadata.yaml"
    try:
        text = read_file(listing, LISTING_LIMIT).decode() if listing.exists() else ""
        bags = [[p for p in folder.iterdir() if p.name.endswith(kind)] for kind in BAGS]
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(folder, str(error), "bag") from None
    names = list(dict.fromkeys(Path(name).name for name in _LISTED.findall(text)))
    if names:  # names only: a listing can't lead out of its folder
        missing = [name for name in names if not (folder / name).exists()]
        if missing:
            raise GroundedError(found("file.listed", str(listing), name=missing[0]))
        return [folder / name for name in names]
    inside = next((paths for paths in bags if paths), [])
    if not inside:
        raise _no_log_in(folder)
    return sorted(inside, key=lambda path: _natural(path.name))


def _missing(path: Path) -> GroundedError:
    """Return the error for a file that does not exist, with the logs that it may stand for."""
    from difflib import get_close_matches

    if not path.parent.is_dir():
        return GroundedError(found("file.missing", str(path), folder=str(path.parent)))
    there = [p for p in path.parent.iterdir() if p.name.endswith(KINDS)]
    there = [p for p in there if not _NO_LOG.fullmatch(p.name) and not _is_candidate(p)]
    logs = sorted(there, key=lambda p: -_written(p))
    plain = _DIGITS.sub("0", path.stem.lower())
    named = {p.stem.lower(): p.name for p in reversed(logs)}  # endings make all names alike
    close = get_close_matches(path.stem.lower(), named, n=1)
    close += [stem for stem in named if _DIGITS.sub("0", stem) == plain]  # another number
    near = named[close[0]] if close else ""
    newest = () if close else tuple(p.name for p in logs[:NEWEST])
    return GroundedError(
        found("file.missing", str(path), near=near, newest=newest, logs=len(logs) * (not close))
    )


def _unreadable(path: Path, why: str, kind: str = "") -> GroundedError:
    return GroundedError(found("file.unreadable", str(path), why=why, kind=kind))


def _is_candidate(path: Path) -> bool:
    """Return whether a file is a candidate that was exported as .npz, by the names in it."""
    from grounded_trials.formats.tables import CANDIDATE

    with suppress(OSError, GroundedError, BadZipFile):
        return within(path, path.stat().st_size, _names_in, path) >= CANDIDATE
    return False


def _names_in(path: Path) -> set[str]:
    with ZipFile(path) as archive:
        return {name.removesuffix(".npy") for name in archive.namelist()}


def _written(path: Path) -> float:
    """Return when a file was last written [s]; 0 if it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:
        return 0.0


def _no_log_in(folder: Path) -> GroundedError:
    tables = sorted(path.name for path in folder.iterdir() if path.name.endswith(".csv"))
    several = tuple(tables[:NEWEST]) if len(tables) > 1 else ()
    workspace = int((folder / "grounded.toml").is_file())
    return GroundedError(
        found("file.no_log_inside", str(folder), tables=several * (not workspace), own=workspace)
    )


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts bag_2 before bag_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in _DIGITS.split(name)]


def open_log(path: Path) -> BinaryIO:
    """Open a log for reading.

    Raises:
        GroundedError: if it can't be opened, or is not a regular file (a pipe, a device).
    """
    try:
        return open_file(path)
    except FileNotFoundError:
        raise _missing(path) from None
    except IsADirectoryError:
        raise GroundedError(found("file.folder", str(path))) from None
    except OSError as error:
        raise _unreadable(path, str(error.strerror)) from None


def empty(path: Path) -> GroundedError:
    """Return the error for a log without a single byte."""
    return GroundedError(found("file.empty", str(path)))


def log_records(path: Path) -> Iterator[Record]:
    """Yield the records of one file of any supported format; only in `read_apart`.

    Raises:
        GroundedError: if it can't be read, is damaged, or is not a log.
    """
    with open_log(path) as stream:
        head = stream.read(16)
        if not head:
            raise empty(path)
        if not head.startswith(_ZSTD):
            yield from _by_format(path, head, stream)
            return
        with tempfile.TemporaryDirectory() as room:
            inner = Path(room) / path.stem
            _expand(path, stream, inner)
            with inner.open("rb") as expanded:
                yield from _by_format(inner, expanded.read(16), expanded)


def _by_format(path: Path, head: bytes, stream: BinaryIO) -> Iterator[Record]:
    from grounded_trials.formats import bags, tables, text_tables

    begins: dict[bytes, tuple[str, Callable[[Path], Iterator[Record]]]] = {
        bags.SQLITE: ("ROS 2 bag", bags.sqlite_records),
        bags.ROS1: ("ROS 1 bag", bags.ros1_records),
        tables.ULOG: ("PX4 log", tables.ulog_records),
        tables.ZIP: ("NumPy archive", tables.npz_records),
    }
    reader = next((one for magic, one in begins.items() if head.startswith(magic)), None)
    if head.startswith(MAGIC[:5]) or path.name.endswith(".mcap"):
        reader = "MCAP log", lambda path: read_records(stream, str(path))
    elif reader is None and path.suffix in (".csv", ".tsv", ".txt"):
        reader = "table", text_tables.csv_records
    if reader is None:
        raise GroundedError(found("file.no_log", str(path), head=repr(head[:8])))
    kind, read = reader
    try:
        yield from map(_plain, read(path))
    except GroundedError:
        raise
    except Exception as error:  # a decoder raises whatever a damaged file leads to
        why = f"{type(error).__name__}: {error}"
        raise _unreadable(path, why[:500], kind) from error


def _plain(record: Record) -> Record:
    """Decompress the messages of a record if each is compressed (rosbag2's mode "message").

    No CDR message begins like a zstd frame.
    """
    if isinstance(record, Messages) and len(record):
        start = int(record.starts[0])
        if record.buffer[start : start + 4] == _ZSTD:
            from grounded_trials.formats.bags import expanded

            return expanded(record)
    return record


def _expand(path: Path, stream: BinaryIO, target: Path) -> None:
    import zstandard

    stream.seek(0)
    decoder = zstandard.ZstdDecompressor(max_window_size=2**27)
    try:
        with target.open("wb") as out:
            decoder.copy_stream(stream, out)
    except (zstandard.ZstdError, OSError) as error:
        raise _unreadable(path, str(error), "zstd file") from error


def read_apart(
    paths: str | Path | Sequence[str | Path],
    function: Callable[Concatenate[tuple[Path, ...], P], T],
    *args: P.args,
    **kwargs: P.kwargs,
) -> T:
    """Return function(files, ...) for the files of a log, computed in a child process.

    Raises:
        GroundedError: as `log_files` and `within`.
    """
    files = log_files(paths)
    size = sum(file.stat().st_size for file in files)
    return within(files[0], size, function, files, *args, **kwargs)


def kind_of(path: Path) -> str:
    """Return the `format` stated in a file written by grounded, "" for any other file.

    Damage is ignored here; it is reported when the file is read.
    """
    try:
        with open_log(path) as stream:
            head = stream.read(len(MAGIC))
        if head.startswith(_ZSTD):
            return read_apart(path, _stated_packed)
        with open_log(path) as stream:
            return _stated(read_records(stream, str(path), packed=False)) if head == MAGIC else ""
    except GroundedError:
        return ""


def _stated_packed(files: tuple[Path, ...]) -> str:
    return _stated(log_records(files[0]))


def _stated(records: Iterator[Record]) -> str:
    for record in records:
        if isinstance(record, Metadata) and record.name == "grounded":
            return record.data.get("format", "")
        if isinstance(record, Messages):
            return ""
    return ""
