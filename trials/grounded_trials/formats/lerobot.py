"""The episodes of a LeRobot data set, and what it says of itself; `parquet` reads their numbers.

A data set is a folder with meta/info.json, which names the numbers of each feature; its episodes
are files of their own (v2) or parts of common ones, which meta/episodes lists (v3). An episode has
the path FOLDER/episode_000003, whatever the version.

Source: `datasets/dataset_metadata.py` and `feature_utils.py` of huggingface/lerobot.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from grounded.checks import refused
from grounded_trials.plain_file import read_file

EPISODE = re.compile(r"episode_(\d+)")
INFO_LIMIT = 2**20  # [bytes] of a meta/info.json
EPISODE_LIMIT = 10**6


def is_dataset(folder: Path) -> bool:
    """Check whether a folder is a LeRobot data set."""
    return (folder / "meta" / "info.json").is_file()


def is_episode(path: Path) -> bool:
    """Check whether a path names an episode of a LeRobot data set."""
    named = EPISODE.fullmatch(path.name) is not None
    return named and is_dataset(path.parent) and not path.exists()


def episodes(folder: Path) -> list[Path]:
    """Return the paths of a data set's episodes, in order."""
    return [folder / f"episode_{k:06d}" for k in range(int(info_of(folder)["total_episodes"]))]


def episode_files(path: Path) -> list[Path]:
    """Return the files in which an episode may be, and which say where it is."""
    folder = path.parent
    alone = sorted(folder.glob(f"data/*/{path.name}.parquet"))
    return alone or [*folder.glob("data/*/*.parquet"), *folder.glob("meta/episodes/*/*.parquet")]


def info_of(folder: Path) -> dict[str, Any]:
    """Return meta/info.json with all that is read of it."""
    path = folder / "meta" / "info.json"
    needed = {"features": dict, "total_episodes": int, "fps": (int, float), "data_path": str}
    try:
        read = json.loads(read_file(path, INFO_LIMIT))
        info = {"codebase_version": "", "chunks_size": 1000, **read}
        bad = [key for key, kind in needed.items() if not isinstance(info.get(key), kind)]  # type: ignore[arg-type]
        if not bad:
            bad += ["fps"] * (not info["fps"] > 0)
            bad += ["total_episodes"] * (not 0 < info["total_episodes"] <= EPISODE_LIMIT)
        why = ", ".join(bad)
    except (ValueError, TypeError, RecursionError) as error:
        why = str(error) or type(error).__name__
    if why:
        raise refused("file.unreadable", path, why=why, kind="LeRobot data set")
    return info | {"features": {k: v for k, v in info["features"].items() if isinstance(v, dict)}}
