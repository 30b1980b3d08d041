"""Convert parquet tables, and the episodes of LeRobot's data sets, to log records.

A table's columns of numbers become the topic /parquet; lists of one length are arrays. A LeRobot
data set is a folder with meta/info.json, which names the numbers of each feature; its episodes are
files of their own (v2) or parts of common ones, which meta/episodes lists (v3). An episode has the
path FOLDER/episode_000003, whatever the version. Its features become topics: /observation/state,
and last /action. Images are not read.

Source: `datasets/dataset_metadata.py` and `feature_utils.py` of huggingface/lerobot.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import wrong
from grounded.errors import GroundedError
from grounded.findings import found
from grounded_trials.formats.mcap_records import Header, Record
from grounded_trials.formats.tables import (
    AS_IT_SAYS,
    Columns,
    Layout,
    column_name,
    columns_by_name,
    table_records,
)
from grounded_trials.plain_file import read_file

EPISODE = re.compile(r"episode_(\d+)")
INFO_LIMIT = 2**20  # [bytes] of a meta/info.json
EPISODE_LIMIT = 10**6
WIDEST = 100  # numbers of a list that is an array of signals; longer ones are pictures or scans
COUNTED = ("frame_index", "episode_index", "index", "task_index", "timestamp")  # no signals
FIRST, LAST = ("observation.state",), ("action",)  # order of the topics
IDS = ("episode_index", "data/chunk_index", "data/file_index")  # of a file in meta/episodes


def is_dataset(folder: Path) -> bool:
    """Check whether a folder is a LeRobot data set."""
    return (folder / "meta" / "info.json").is_file()


def is_episode(path: Path) -> bool:
    """Check whether a path names an episode of a LeRobot data set."""
    named = EPISODE.fullmatch(path.name) is not None
    return named and is_dataset(path.parent) and not path.exists()


def episodes(folder: Path) -> list[Path]:
    """Return the paths of a data set's episodes, in order.

    Raises:
        GroundedError: if its meta/info.json can't be used.
    """
    return [folder / f"episode_{k:06d}" for k in range(int(_info(folder)["total_episodes"]))]


def episode_files(path: Path) -> list[Path]:
    """Return the files in which an episode may be, and which say where it is."""
    folder = path.parent
    alone = sorted(folder.glob(f"data/*/{path.name}.parquet"))
    return alone or [*folder.glob("data/*/*.parquet"), *folder.glob("meta/episodes/*/*.parquet")]


def parquet_records(path: Path, layout: Layout = AS_IT_SAYS) -> Iterator[Record]:
    """Yield the records of a parquet table, which needs a column of times or a rate.

    A file with one episode of a LeRobot data set is read as that.

    Raises:
        GroundedError: if it has no times.
    """
    home = next((one for one in path.parents[:3] if is_dataset(one)), None)
    if home is not None and EPISODE.fullmatch(path.stem):
        yield from episode_records(home / path.stem)
        return
    file = _opened(path)
    named = [
        (column_name(name), name, values)
        for column in file.schema_arrow.names
        for name, values in _numbers(column, file.read([column], use_threads=False)[column])
    ]
    yield from table_records(
        {"/parquet": columns_by_name(named, path)}, "parquet", path, layout.rate
    )


def episode_records(path: Path) -> Iterator[Record]:
    """Yield the records of an episode, FOLDER/episode_000003.

    Raises:
        GroundedError: if the data set's meta/info.json can't be used, or it has no such episode.
    """
    folder, number = path.parent, int(path.name.partition("_")[2])
    info = _info(folder)
    features = {
        key: one
        for key, one in info["features"].items()
        if key not in COUNTED and not key.startswith("next.") and _is_signal(one)
    }
    file, rows = _rows_of(folder, info, number, [*features, "frame_index", "timestamp"])
    if not len(rows.get("frame_index", ())):
        high = info["total_episodes"] - 1
        raise wrong("episode", got=path.name, must="whole", low=0, high=high)
    times = rows["frame_index"][:, 0] / float(info["fps"])
    tables: dict[str, Columns] = {}
    for key in sorted(features, key=lambda key: (key not in FIRST, key in LAST)):
        if key in rows:
            names = _names(features[key], rows[key].shape[1])
            columns = zip(names, names, rows[key].T, strict=True)
            tables["/" + key.replace(".", "/")] = {"timestamp_s": times} | columns_by_name(
                columns, file
            )
    writer = f"LeRobot {info['codebase_version']}, episode {number} of {info['total_episodes']}"
    for record in table_records(tables, "lerobot", path):
        yield replace(record, library=writer) if isinstance(record, Header) else record


def _info(folder: Path) -> dict[str, Any]:
    """Return meta/info.json with all that is read of it.

    Raises:
        GroundedError: if something is missing.
    """
    path = folder / "meta" / "info.json"
    try:
        info = json.loads(read_file(path, INFO_LIMIT))
        info = {"codebase_version": "", "chunks_size": 1000, **info}
        needed = {"features": dict, "total_episodes": int, "fps": (int, float), "data_path": str}
        bad = [key for key, kind in needed.items() if not isinstance(info.get(key), kind)]  # type: ignore[arg-type]
        if not bad:
            kept = {key: one for key, one in info["features"].items() if isinstance(one, dict)}
            bad += ["fps"] * (not info["fps"] > 0)
            bad += ["total_episodes"] * (not 0 < info["total_episodes"] <= EPISODE_LIMIT)
        if not bad:
            return info | {"features": kept}
        why = ", ".join(bad)
    except (ValueError, TypeError, RecursionError) as error:
        why = str(error)
    raise GroundedError(found("file.unreadable", str(path), why=why, kind="LeRobot data set"))


def _is_signal(feature: Mapping[str, Any]) -> bool:
    """Check whether a feature holds a few numbers a frame."""
    kind, shape = str(feature.get("dtype")), feature.get("shape") or [1]
    few = len(shape) == 1 and 0 < int(shape[0]) <= WIDEST
    return few and re.match(r"float|u?int|bool", kind) is not None


def _names(feature: Mapping[str, Any], count: int) -> list[str]:
    """Return the names of a feature's numbers; names that are not one each are not used."""
    said = feature.get("names")
    while isinstance(said, dict):  # {"motors": [...]}
        said = next(iter(said.values()), None)
    # a joint's position is `elbow.pos` there
    names = [str(name).removesuffix(".pos") for name in said] if isinstance(said, list) else []
    names = list(map(column_name, names))
    if len(names) != count or not all(names):
        names = ["value"] if count == 1 else [f"value[{i}]" for i in range(count)]
    again = Counter(names)
    return [f"{name}_{i}" if again[name] > 1 else name for i, name in enumerate(names)]


def _rows_of(
    folder: Path, info: Mapping[str, Any], number: int, wanted: Sequence[str]
) -> tuple[Path, dict[str, Any]]:
    """Return the file with an episode, and its columns as arrays (N, k)."""
    place = {"episode_index": number, "episode_chunk": number // max(int(info["chunks_size"]), 1)}
    for listing in sorted(folder.glob("meta/episodes/*/*.parquet")):
        known, chunk, file = (values[:, 0] for values in _read(listing, IDS).values())
        at = np.flatnonzero(known == number)
        if len(at):
            place |= {"chunk_index": int(chunk[at[0]]), "file_index": int(file[at[0]])}
            break
    try:
        path = folder / str(info["data_path"]).format(**place)
    except (KeyError, IndexError, ValueError, AttributeError):
        return folder, {}
    if not path.is_file() or not path.resolve().is_relative_to(folder.resolve()):
        return path, {}
    return path, _read(path, wanted, number)


def _read(path: Path, names: Sequence[str], episode: int | None = None) -> dict[str, Any]:
    """Return columns of a file as arrays (N, k), of one episode or of all rows."""
    file, key = _opened(path), "episode_index"
    there = [name for name in names if name in file.schema_arrow.names]
    parts: dict[str, list[Any]] = {name: [] for name in there}
    for group in range(file.num_row_groups):
        if episode is not None and not _may_hold(file, group, key, episode):
            continue
        table = file.read_row_group(group, list({*there, key}), use_threads=False)
        rows = slice(None)
        if episode is not None:
            rows = np.asarray(table[key]) == episode
        for name in there:
            columns = [values for _, values in _numbers(name, table[name])]
            if columns:
                parts[name].append(np.column_stack(columns)[rows])
    return {name: np.concatenate(some) for name, some in parts.items() if some}


def _may_hold(file: Any, group: int, key: str, value: int) -> bool:
    """Check by its statistics whether a row group may hold a value of a column."""
    about = file.metadata.row_group(group)
    for i in range(about.num_columns):
        column = about.column(i)
        if column.path_in_schema == key and column.is_stats_set and column.statistics.has_min_max:
            return bool(column.statistics.min <= value <= column.statistics.max)
    return True


def _opened(path: Path) -> Any:
    import pyarrow
    from pyarrow.parquet import ParquetFile

    # the other pools of memory reserve more addresses than a log's limit
    pyarrow.set_memory_pool(pyarrow.system_memory_pool())
    return ParquetFile(path, pre_buffer=False)


def _numbers(name: str, column: Any) -> Iterator[tuple[str, Any]]:
    """Yield the columns of numbers in one of a table: an array's, a struct's, its own, or none."""
    import pyarrow
    from pyarrow import compute, types

    kind = column.type
    if types.is_timestamp(kind):
        yield name, column.cast(pyarrow.timestamp("ns")).cast("int64").to_numpy()
    elif types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind):
        yield name, column.cast("float64", safe=False).to_numpy()
    elif types.is_struct(kind):
        for field, part in zip(kind, column.combine_chunks().flatten(), strict=True):
            yield from _numbers(f"{name}_{field.name}", pyarrow.chunked_array([part]))
    elif types.is_list(kind) or types.is_fixed_size_list(kind) or types.is_large_list(kind):
        lengths = compute.min_max(compute.list_value_length(column)).as_py()
        width = lengths["max"] or 0
        if column.null_count or lengths["min"] != width or not 0 < width <= WIDEST:
            return
        for _, values in _numbers(name, pyarrow.chunked_array([compute.list_flatten(column)])):
            for i, part in enumerate(values.reshape(-1, width).T):
                yield f"{name}[{i}]", part
