"""Which files a log consists of: one, several in order, or a bag's folder with split files.

What a file says it is, from its first records: one of ours, or somebody else's log.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from grounded.errors import GroundedError, nearest
from grounded_trials.formats.budget import budget
from grounded_trials.formats.mcap_records import Messages, Metadata
from grounded_trials.formats.mcap_walk import read_records
from grounded_trials.plain_file import open_file, read_file

_LISTED = re.compile(r"^\s*-\s+(?:path:\s*)?[\"']?([^\"'\s#]+\.mcap)[\"']?\s*$", re.MULTILINE)
LISTING_LIMIT = 2**24  # [bytes] of a metadata.yaml
_DIGITS = re.compile(r"(\d+)")


def log_files(paths: str | Path | Sequence[str | Path]) -> tuple[Path, ...]:
    """The MCAP files of a log in order.

    Args:
        paths: a file, files in order, or the folder of a bag. A folder's metadata.yaml says which
            files it has and in which order; without it, all *.mcap in the order of their numbers.

    Raises:
        GroundedError: if one of them is missing, or a folder has none.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    files: list[Path] = []
    for path in map(Path, given):
        files.extend(_bag(path) if path.is_dir() else [path])
    for path in files:
        if not path.exists():
            raise GroundedError(f"{path} does not exist{_nearby(path)}")
    if not files:
        raise GroundedError("no log was given")
    return tuple(files)


def _bag(folder: Path) -> list[Path]:
    listing = folder / "metadata.yaml"
    try:
        text = read_file(listing, LISTING_LIMIT).decode() if listing.exists() else ""
        inside = [path for path in folder.iterdir() if path.suffix == ".mcap"]
    except (OSError, UnicodeDecodeError) as error:
        raise GroundedError(f"{folder} can't be read as a bag: {error}") from None
    names = list(dict.fromkeys(Path(name).name for name in _LISTED.findall(text)))
    if names:  # names only: a listing can't lead out of its folder
        missing = [name for name in names if not (folder / name).exists()]
        if missing:
            raise GroundedError(
                f"{listing} lists {missing[0]}, which is not in the folder; "
                "give the files that are there one by one"
            )
        return [folder / name for name in names]
    if not inside:
        raise GroundedError(f"{folder} holds no *.mcap file{_advice(folder)}")
    return sorted(inside, key=lambda path: _natural(path.name))


def _nearby(path: Path) -> str:
    """What to do about a file that is not there."""
    if not path.parent.is_dir():
        return f", nor does its folder {path.parent}: name a log, seen from the folder you are in"
    names = sorted(p.name for p in path.parent.glob("*.mcap"))
    if names:
        return f": {nearest(path.name, names[:5])}"
    return ": name an MCAP file or a bag's folder, seen from the folder you are in"


def _advice(folder: Path) -> str:
    if (folder / "grounded.toml").is_file():
        return "; it is a workspace: name the log, or its folder, inside"
    kinds = {path.suffix for path in folder.iterdir()}
    if ".db3" in kinds:
        return "; turn its .db3 into MCAP with `ros2 bag convert` or `mcap convert`"
    if ".zstd" in kinds:
        return "; decompress its files first, with `zstd -d`"
    return ""


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts bag_2 before bag_10."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in _DIGITS.split(name)]


def open_log(path: Path) -> BinaryIO:
    """Opens a log for reading.

    Raises:
        GroundedError: if it can't be, or is no file at all (a pipe, a device).
    """
    try:
        return open_file(path)
    except FileNotFoundError:
        raise GroundedError(f"{path} does not exist{_nearby(path)}") from None
    except IsADirectoryError:
        raise GroundedError(f"{path} is a folder: name a file in it") from None
    except OSError as error:
        raise GroundedError(f"{path} can't be read: {error.strerror}") from None


@contextmanager
def reading(paths: str | Path | Sequence[str | Path]) -> Iterator[tuple[Path, ...]]:
    """The files of a log, and a budget of time and memory for what is decoded of them.

    Raises:
        GroundedError: as `log_files`, and where the budget is used up.
    """
    files = log_files(paths)
    with budget(str(files[0]), files):
        yield files


def kind_of(path: Path) -> str:
    """The `format` that a file of ours states ahead of its messages, "" for any other file.

    Damage is not judged here: whoever reads the file does that.
    """
    try:
        with reading(path), open_log(path) as stream:
            for record in read_records(stream, str(path)):
                if isinstance(record, Metadata) and record.name == "grounded":
                    return record.data.get("format", "")
                if isinstance(record, Messages):
                    return ""
    except GroundedError:
        return ""
    return ""
