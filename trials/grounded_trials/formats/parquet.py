"""Read parquet tables, and the episodes of LeRobot's data sets.

A table's columns of numbers become the topic /parquet; lists of one length are arrays. The features
of an episode (`lerobot`) become topics: /observation/state, and last /action. Images are not read.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from grounded.checks import wrong
from grounded_trials.formats.lerobot import EPISODE, info_of, is_dataset
from grounded_trials.formats.tables import (
    AS_IT_SAYS,
    Layout,
    Tables,
    column_name,
    columns_by_name,
)

WIDEST = 100  # numbers of a list that is an array of signals; longer ones are pictures or scans
COUNTED = ("frame_index", "episode_index", "index", "task_index", "timestamp")  # no signals
FIRST, LAST = ("observation.state",), ("action",)  # order of the topics
KEY = "episode_index"
PLACES = {"data/chunk_index": "chunk_index", "data/file_index": "file_index"}  # in meta/episodes


def parquet_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return a parquet table, or of a file with one episode of a LeRobot data set that."""
    home = next((one for one in path.parents[:3] if is_dataset(one)), None)
    if home is not None and EPISODE.fullmatch(path.stem):
        return episode_tables(home / path.stem)
    table = _read(path)
    named = [
        (column_name(name), values)
        for column in table.column_names
        for name, values in _numbers(column, table[column])
    ]
    return {"/parquet": columns_by_name(named, path)}


def episode_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the features of an episode, FOLDER/episode_000003, a table each."""
    folder, number = path.parent, int(path.name.partition("_")[2])
    info = info_of(folder)
    file = _file_of(folder, info, number)
    table = _read(file, filters=[(KEY, "=", number)]) if file else None
    if table is None or not len(table) or "frame_index" not in table.column_names:
        high = info["total_episodes"] - 1
        raise wrong("episode", got=path.name, must="whole", low=0, high=high)
    times = {"timestamp_s": table["frame_index"].to_numpy() / float(info["fps"])}
    tables: Tables = {}
    for key in sorted(info["features"], key=lambda key: (key not in FIRST, key in LAST)):
        feature, counted = info["features"][key], key in COUNTED or key.startswith("next.")
        if key in table.column_names and not counted and _is_signal(feature):
            columns = [values for _, values in _numbers(key, table[key])]
            named = zip(_names(feature, len(columns)), columns, strict=True)
            tables["/" + key.replace(".", "/")] = times | columns_by_name(named, path)
    return tables


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


def _file_of(folder: Path, info: Mapping[str, Any], number: int) -> Path | None:
    """Return the file with an episode, None if the data set has none of its own."""
    place = {KEY: number, "episode_chunk": number // max(int(info["chunks_size"]), 1)}
    for listing in sorted(folder.glob("meta/episodes/*/*.parquet")):
        rows = _read(listing, columns=list(PLACES), filters=[(KEY, "=", number)]).to_pylist()
        place |= {name: row[key] for row in rows[:1] for key, name in PLACES.items()}
    try:
        path = folder / str(info["data_path"]).format(**place)
    except (KeyError, IndexError, ValueError, AttributeError):
        return None
    return path if path.is_file() and path.resolve().is_relative_to(folder.resolve()) else None


def _read(path: Path, **some: Any) -> Any:
    """Return a parquet file as a table of pyarrow; for `some` see `pyarrow.parquet.read_table`."""
    import pyarrow
    from pyarrow.parquet import read_table

    # the other pools of memory reserve more addresses than a log's limit
    pyarrow.set_memory_pool(pyarrow.system_memory_pool())
    return read_table(path, use_threads=False, pre_buffer=False, partitioning=None, **some)


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
