"""The files of a log: a file, several files in order, or a bag's folder with split files.

An episode of a LeRobot data set is a log whose path is no file: FOLDER/episode_000003 (`lerobot`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from grounded.checks import refused
from grounded.errors import GroundedError, alike
from grounded_trials.formats import lerobot
from grounded_trials.plain_file import open_file, read_file, unreadable


@dataclass(frozen=True)
class Format:
    """A log format other than MCAP: how its files are called and begin, and what reads them."""

    kind: str  # its name in messages
    suffix: str
    begins: bytes  # the first bytes of a file
    reader: str  # module of `formats`, and its function
    writes: str = ""  # of tables (path, layout) -> Tables: the kind of their types; "": (path)
    library: str = ""  # that the reader needs
    extra: str = ""  # of grounded's, with which the library comes


CSV = Format("table", ".csv", b"", "text_tables.csv_tables", "csv")
PYARROW = "pyarrow.parquet", "parquet"
EPISODE = Format("LeRobot data set", "", b"", "parquet.episode_tables", "lerobot", *PYARROW)
FORMATS = (
    Format("ROS 2 bag", ".db3", b"SQLite format 3\0", "bags.sqlite_records"),
    Format("ROS 1 bag", ".bag", b"#ROSBAG", "bags.ros1_records"),
    Format("PX4 log", ".ulg", b"ULog\x01\x12\x35", "tables.ulog_tables", "ulog", "pyulog", "px4"),
    Format("NumPy archive", ".npz", b"PK\x03\x04", "tables.npz_tables", "npz"),
    Format("ArduPilot log", ".bin", b"\xa3\x95\x80", "dataflash.dataflash_tables", "dataflash"),
    Format("MATLAB file", ".mat", b"MATLAB 5.0", "mat.mat_tables", "mat", "scipy.io"),
    Format("MATLAB file", ".mat", b"MATLAB 7.3", "mat.mat73_tables", "mat", "h5py", "matlab"),
    Format("parquet table", ".parquet", b"PAR1", "parquet.parquet_tables", "parquet", *PYARROW),
)
BAGS = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")  # files of a bag's folder
KINDS = (*BAGS, *(one.suffix for one in (CSV, *FORMATS)))
NAMED = 3  # most tables named of a folder that is no log
LISTING_LIMIT = 2**24  # [bytes] of a metadata.yaml
_LISTED = re.compile(
    r"^[ \t]*-[ \t]+(?:path:[ \t]*)?[\"']?([^\"'\s#]+\.(?:mcap|db3)(?:\.zstd)?)[\"']?[ \t\r]*$",
    re.MULTILINE,
)
_NO_LOG = re.compile(r"c\d{4,}\.\w+|target\.csv")  # an exported candidate, or a target


def logs_in(path: Path) -> list[Path]:
    """Return the logs that a path names: the runs in a folder, or the path itself.

    The runs are the episodes of a LeRobot data set, or the files of a folder that is no bag, if
    its tables have equally many columns.
    """
    if not path.is_dir():
        return [path]
    if lerobot.is_dataset(path):
        return lerobot.episodes(path)
    if (path / "grounded.toml").is_file() or _bag(path):
        return [path]
    runs = _sorted(_logs(path))
    return runs if runs and len({*map(_width, runs)}) == 1 else [path]


def _logs(folder: Path) -> list[Path]:
    """Return the files of a folder that may be logs: no exported candidate, no target."""
    return [p for p in _listed(folder) if p.name.endswith(KINDS) and not _NO_LOG.fullmatch(p.name)]


def _width(path: Path) -> int:
    """Return how many words the first line of a text table has, 0 for another file."""
    if path.suffix != ".csv":
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
    files: list[Path] = []
    for path in map(Path, [paths] if isinstance(paths, str | Path) else paths):
        inside = [path]
        if path.is_dir():
            inside = [] if lerobot.is_dataset(path) else _bag(path)
            inside = inside or logs_in(path)[:1]
            if inside == [path]:
                own = int((path / "grounded.toml").is_file())
                tables = sorted(p.name for p in _listed(path) if p.suffix == ".csv" and not own)
                several = tuple(tables[:NAMED]) if len(tables) > 1 else None
                raise refused("file.no_log", path, own=own, tables=several)
        files.extend(inside)
    for path in files:
        if not path.exists() and not lerobot.is_episode(path):
            raise _missing(path)
    if not files:
        raise refused("file.missing", "log")
    return tuple(files)


def _bag(folder: Path) -> list[Path]:
    """Return the files of a bag in order, [] if a folder is none."""
    listing = folder / "metadata.yaml"
    try:
        text = read_file(listing, LISTING_LIMIT).decode() if listing.exists() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise unreadable(folder, str(error), kind="bag") from None
    names = list(dict.fromkeys(Path(name).name for name in _LISTED.findall(text)))
    for name in names:  # names only: a listing can't lead out of its folder
        if not (folder / name).exists():
            raise refused("file.missing", name, where=str(listing))
    if names:
        return [folder / name for name in names]
    there = _listed(folder)
    bags = ([p for p in there if p.name.endswith(kind)] for kind in BAGS)
    return _sorted(next((paths for paths in bags if paths), []))


def _listed(folder: Path) -> list[Path]:
    try:
        return [*folder.iterdir()]
    except OSError as error:
        raise unreadable(folder, str(error), kind="bag") from None


def _sorted(paths: Iterable[Path]) -> list[Path]:
    """Sort files by the numbers in their names: bag_2 before bag_10."""

    def natural(path: Path) -> list[tuple[int, str]]:
        parts = re.split(r"(\d+)", path.name)
        return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]

    return sorted(paths, key=natural)


def _missing(path: Path) -> GroundedError:
    """Return the error for a file that does not exist, with the log that it may stand for."""
    if not path.parent.is_dir():
        return refused("file.missing", path, folder=str(path.parent))
    named = {p.stem: p.name for p in sorted(_logs(path.parent))}  # endings make all names alike
    return refused("file.missing", path, near=named.get(alike(path.stem, named), ""))


def open_log(path: Path) -> BinaryIO:
    """Open a log for reading."""
    try:
        return open_file(path)
    except FileNotFoundError:
        raise _missing(path) from None
    except IsADirectoryError:
        raise unreadable(path, "folder") from None
    except OSError as error:
        raise unreadable(path, error) from None


def empty(path: Path) -> GroundedError:
    """Return the error for a log without a single byte."""
    return refused("file.no_message", path, byte=0)


def on_disk(log: Path) -> list[Path]:
    """Return the files on the disk that a log's file is read from; several for an episode."""
    return lerobot.episode_files(log) if lerobot.is_episode(log) else [log]
