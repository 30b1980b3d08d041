"""LeRobot data sets as the library writes them: v2 an episode a file, v3 several in one."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

FPS = 30


def dataset(
    folder: Path,
    version: str,
    names: Sequence[str],
    episodes: Sequence[Mapping[str, np.ndarray]],
    **info: object,
) -> Path:
    """Write a data set: `observation.state` and `action` (N, k) of each episode, and an image."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    feature = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    one = {"dtype": "int64", "shape": [1], "names": None}
    about = {
        "codebase_version": version,
        "robot_type": "so100",
        "total_episodes": len(episodes),
        "chunks_size": 1000,
        "fps": FPS,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
        if version < "v3"
        else "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "features": {
            "action": feature,
            "observation.state": feature,
            "observation.images.top": {"dtype": "image", "shape": [4, 4, 3], "names": None},
            "timestamp": one | {"dtype": "float32"},
            "frame_index": one,
            "episode_index": one,
            "next.done": one | {"dtype": "bool"},
        },
    } | info
    tables, start = [], 0
    for k, episode in enumerate(episodes):
        steps = np.arange(len(episode["action"]))
        columns = {key: pa.array(list(a.astype(np.float32))) for key, a in episode.items()}
        image = {"bytes": b"png", "path": ""}
        columns |= {
            "observation.images.top": pa.array([image] * len(steps)),
            "timestamp": pa.array((steps / FPS).astype(np.float32)),
            "frame_index": pa.array(steps),
            "episode_index": pa.array(np.full(len(steps), k)),
            "next.done": pa.array(steps == steps[-1]),
        }
        tables.append(pa.table(columns))
        start += len(steps)
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(about))
    data = folder / "data" / "chunk-000"
    data.mkdir(parents=True)
    if version < "v3":
        for k, table in enumerate(tables):
            pq.write_table(table, data / f"episode_{k:06d}.parquet")
        return folder
    # all but the last in one file, as LeRobot fills a file before it begins the next
    parts = [tables[:-1], tables[-1:]]
    for number, part in enumerate(parts):
        with pq.ParquetWriter(data / f"file-{number:03d}.parquet", tables[0].schema) as out:
            for table in part:
                out.write_table(table)
    listing = folder / "meta" / "episodes" / "chunk-000"
    listing.mkdir(parents=True)
    last = len(episodes) - 1
    index = {
        "episode_index": list(range(len(episodes))),
        "data/chunk_index": [0] * len(episodes),
        "data/file_index": [int(k == last) for k in range(len(episodes))],
    }
    pq.write_table(pa.table(index), listing / "file-000.parquet")
    return folder
