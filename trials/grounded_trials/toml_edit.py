"""Changes in the user's grounded.toml that leave their comments and layout alone (tomlkit)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from grounded_trials.store import write_atomically


def set_in_model(
    file: Path,
    params: Mapping[str, float] | None = None,
    effects: Sequence[Mapping[str, Any]] | None = None,
) -> None:
    """Replaces [model] params and/or effects; the rest of the file stays as it is.

    Raises:
        GroundedError: if the file can't be written.
    """
    import tomlkit

    document = tomlkit.parse(file.read_text(encoding="utf-8"))
    model: Any = document["model"]
    if params is not None:
        model["params"] = _inline(params)
    if effects is not None:
        array = tomlkit.array()
        for effect in effects:
            array.append(_inline(effect))
        model["effects"] = array.multiline(len(effects) > 1)
    write_atomically(file, tomlkit.dumps(document).encode())


def set_latency(file: Path, latency: Mapping[str, float]) -> None:
    """Replaces [task] latency."""
    import tomlkit

    document = tomlkit.parse(file.read_text(encoding="utf-8"))
    task: Any = document["task"]
    task["latency"] = _inline(latency)
    write_atomically(file, tomlkit.dumps(document).encode())


def _inline(values: Mapping[str, Any]) -> Any:
    import tomlkit

    table = tomlkit.inline_table()
    table.update(dict(values))
    return table
