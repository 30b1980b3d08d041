"""The files of a log, and the records of each, in any supported format.

A log is a file, several files in order, or a bag's folder with split files. The format is detected
by the first bytes (`FORMATS`), not by the name, in a file compressed with zstd as well; else it is
a text table. An episode of a LeRobot data set is a log whose path is no file: FOLDER/episode_000003
(`parquet`). Every format is converted to MCAP records, so callers need not know it.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, Concatenate, ParamSpec, TypeVar

from grounded.errors import GroundedError, alike, needs
from grounded.findings import found
from grounded_trials.formats import dataflash, parquet, text_tables
from grounded_trials.formats.mcap_records import MAGIC, Channel, Messages, Metadata, Record, Rows
from grounded_trials.formats.mcap_walk import mapped, read_records
from grounded_trials.formats.tables import AS_IT_SAYS, Layout, table_records
from grounded_trials.formats.text_tables import SUFFIXES
from grounded_trials.plain_file import open_file, read_file
from grounded_trials.within import within

P = ParamSpec("P")
T = TypeVar("T")
BAGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")  # files of a bag's folder
KINDS = (*BAGS, ".bag", ".csv", ".npz", ".ulg", ".bin", ".mat", ".parquet")
NAMED = 3  # most tables named of a folder that is no log
LISTING_LIMIT = 2**24  # [bytes] of a metadata.yaml
_ZSTD = b"\x28\xb5\x2f\xfd"
_LISTED = re.compile(
    r"^[ \t]*-[ \t]+(?:path:[ \t]*)?[\"']?([^\"'\s#]+\.(?:mcap|db3)(?:\.zstd)?)[\"']?[ \t\r]*$",
    re.MULTILINE,
)
_NO_LOG = re.compile(r"c\d{4,}\.\w+|target\.csv")  # an exported candidate, or a target
_DIGITS = re.compile(r"(\d+)")


@dataclass(frozen=True)
class Format:
    """A log format: how its files begin, and what reads them."""

    kind: str  # its name in messages
    begins: bytes  # the first bytes of a file
    reader: str  # module of `formats`, and its function
    writes: str = ""  # of tables (path, layout) -> Tables: the kind of their types; "": (path)
    library: str = ""  # that the reader needs
    extra: str = ""  # of grounded's, with which the library comes


CSV = Format("table", b"", "text_tables.csv_tables", "csv")
PYARROW = "pyarrow.parquet", "parquet"
EPISODE = Format("LeRobot data set", b"", "parquet.episode_tables", "lerobot", *PYARROW)
FORMATS = (
    Format("ROS 2 bag", b"SQLite format 3\0", "bags.sqlite_records"),
    Format("ROS 1 bag", b"#ROSBAG", "bags.ros1_records"),
    Format("PX4 log", b"ULog\x01\x12\x35", "tables.ulog_tables", "ulog", "pyulog", "px4"),
    Format("NumPy archive", b"PK\x03\x04", "tables.npz_tables", "npz"),
    Format("ArduPilot log", dataflash.BEGINS, "dataflash.dataflash_tables", "dataflash"),
    Format("MATLAB file", b"MATLAB 5.0", "mat.mat_tables", "mat", "scipy.io"),
    Format("MATLAB file", b"MATLAB 7.3", "mat.mat73_tables", "mat", "h5py", "matlab"),
    Format("parquet table", b"PAR1", "parquet.parquet_tables", "parquet", *PYARROW),
)


def logs_in(path: Path) -> list[Path]:
    """Return the logs that a path names: the runs in a folder, or the path itself.

    The runs are the episodes of a LeRobot data set, or the files of a folder that is no bag, if
    its tables have equally many columns.

    Raises:
        GroundedError: if the data set can't be used.
    """
    if parquet.is_dataset(path):
        return parquet.episodes(path)
    if not path.is_dir() or (path / "grounded.toml").is_file() or _bag(path):
        return [path]
    runs = _sorted(p for p in _listed(path) if p.name.endswith(KINDS) and not _is_none(p))
    return runs if runs and len({*map(_width, runs)}) == 1 else [path]


def _width(path: Path) -> int:
    """Return how many words the first line of a text table has, 0 for another file."""
    if path.suffix not in SUFFIXES:
        return 0
    with open_log(path) as stream:
        return len(re.split(rb"[\t;, ]+", stream.readline(LISTING_LIMIT).strip()))


def log_files(paths: str | Path | Sequence[str | Path]) -> tuple[Path, ...]:
    """Return the files of a log in order.

    Args:
        paths: a file, files in order, or the folder of a bag. A folder's metadata.yaml lists its
            files in order; without it, all *.mcap, else *.db3, sorted by the numbers in their
            names. Of a folder of runs, as a LeRobot data set, it is the first one.

    Raises:
        GroundedError: if a file is missing, or a folder has none.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    files: list[Path] = []
    for path in map(Path, given):
        if path.is_dir():
            inside = [] if parquet.is_dataset(path) else _bag(path)
            inside = inside or logs_in(path)[:1]
            if inside == [path]:
                workspace = int((path / "grounded.toml").is_file())
                tables = () if workspace else sorted(p.name for p in _listed(path))
                several = tuple(n for n in tables if n.endswith(".csv"))[:NAMED]
                facts: dict[str, Any] = {"tables": several} if len(several) > 1 else {}
                raise GroundedError(found("file.no_log", str(path), own=workspace, **facts))
            files.extend(inside)
        else:
            files.append(path)
    for path in files:
        if not path.exists() and not parquet.is_episode(path):
            raise _missing(path)
    if not files:
        raise GroundedError(found("file.missing", "log"))
    return tuple(files)


def _bag(folder: Path) -> list[Path]:
    """Return the files of a bag in order, [] if a folder is none."""
    listing = folder / "metadata.yaml"
    try:
        text = read_file(listing, LISTING_LIMIT).decode() if listing.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(folder, str(error), "bag") from None
    names = list(dict.fromkeys(Path(name).name for name in _LISTED.findall(text)))
    if names:  # names only: a listing can't lead out of its folder
        missing = [name for name in names if not (folder / name).exists()]
        if missing:
            raise GroundedError(found("file.missing", missing[0], where=str(listing)))
        return [folder / name for name in names]
    there = _listed(folder)
    bags = ([p for p in there if p.name.endswith(kind)] for kind in BAGS)
    return _sorted(next((paths for paths in bags if paths), []))


def _listed(folder: Path) -> list[Path]:
    try:
        return [*folder.iterdir()]
    except OSError as error:
        raise _unreadable(folder, str(error), "bag") from None


def _sorted(paths: Iterable[Path]) -> list[Path]:
    """Sort files by the numbers in their names: bag_2 before bag_10."""

    def natural(path: Path) -> list[tuple[int, str]]:
        parts = _DIGITS.split(path.name)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

    return sorted(paths, key=natural)


def _is_none(path: Path) -> bool:
    """Check whether a file is named like an exported candidate or a target, which are no logs."""
    return _NO_LOG.fullmatch(path.name) is not None


def _missing(path: Path) -> GroundedError:
    """Return the error for a file that does not exist, with the log that it may stand for."""
    if not path.parent.is_dir():
        return GroundedError(found("file.missing", str(path), folder=str(path.parent)))
    there = [p for p in path.parent.iterdir() if p.name.endswith(KINDS) and not _is_none(p)]
    named = {p.stem: p.name for p in sorted(there)}  # endings make all names alike
    close = named.get(alike(path.stem, named), "")
    return GroundedError(found("file.missing", str(path), near=close))


def _unreadable(path: Path, why: str, kind: str = "") -> GroundedError:
    return GroundedError(found("file.unreadable", str(path), why=why, kind=kind))


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
        raise _unreadable(path, "folder") from None
    except OSError as error:
        raise _unreadable(path, str(error.strerror)) from None


def empty(path: Path) -> GroundedError:
    """Return the error for a log without a single byte."""
    return GroundedError(found("file.no_message", str(path), byte=0))


def log_records(path: Path, layout: Layout = AS_IT_SAYS) -> Iterator[Record]:
    """Yield the records of one file of any supported format; only in `read_apart`.

    Args:
        path: the file.
        layout: the names and the rate of a table that does not say them.

    Raises:
        GroundedError: if it can't be read, is damaged, or is not a log.
    """
    if parquet.is_episode(path):
        yield from _read_as(EPISODE, path, layout)
        return
    with open_log(path) as stream:
        head = stream.read(16)
        if not head:
            raise empty(path)
        if not head.startswith(_ZSTD):
            yield from _by_format(path, head, stream, layout)
            return
        with tempfile.TemporaryDirectory() as room:
            inner = Path(room) / path.stem
            _expand(path, stream, inner)
            with inner.open("rb") as expanded:
                yield from _by_format(inner, expanded.read(16), expanded, layout)


def _by_format(path: Path, head: bytes, stream: BinaryIO, layout: Layout) -> Iterator[Record]:
    if head.startswith(MAGIC[:5]) or path.name.endswith(".mcap"):
        yield from _guarded("MCAP log", path, read_records(mapped(stream), str(path)))
    elif (format := _format_of(path, head)) is not None:
        yield from _read_as(format, path, layout)
    else:
        raise GroundedError(found("file.no_log", str(path), begins=repr(head[:8])))


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
    try:
        yield from map(_plain, records)
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
    size = sum(one.stat().st_size for file in files for one in on_disk(file))
    for file in files:
        _load_library(file)
    return within(files[0], size, function, files, *args, **kwargs)


def on_disk(log: Path) -> list[Path]:
    """Return the files on the disk that a log's file is read from; several for an episode."""
    return parquet.episode_files(log) if parquet.is_episode(log) else [log]


def _load_library(file: Path) -> None:
    """Import the library that reads a file: its own memory is then not counted as the file's."""
    if parquet.is_episode(file):
        format: Format | None = EPISODE
    else:
        with open_log(file) as stream:
            format = _format_of(file, stream.read(16))
    _load(format)


def _load(format: Format | None) -> None:
    if format is not None and format.library:
        needs(format.library, format.extra)


def column_units(log: Path) -> dict[str, str]:
    """Return the units that a log states for its numbers, by message path.

    A text table does in its column names, ArduPilot's log in messages of its own.
    """
    if log.suffix.lower() in SUFFIXES:
        return dict(text_tables.about_table(log).units)
    if not log.is_file():
        return {}
    with open_log(log) as stream:
        stated = stream.read(3) == dataflash.BEGINS
    return within(log, log.stat().st_size, dataflash.dataflash_units, log) if stated else {}


def digest_of(log: Path) -> str:
    """Return the SHA-256 of what is read of an episode, whatever else its files hold.

    Raises:
        GroundedError: if it can't be read.
    """
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


def kind_of(path: Path) -> str:
    """Return the `format` stated in a file written by grounded, "" for any other file.

    Damage is ignored here; it is reported when the file is read.
    """
    try:
        with open_log(path) as stream:
            head = stream.read(len(MAGIC))
            if head == MAGIC:
                return _stated(read_records(mapped(stream), str(path), packed=False))
        return read_apart(path, _stated_packed) if head.startswith(_ZSTD) else ""
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
