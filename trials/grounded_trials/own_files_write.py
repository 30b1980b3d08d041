"""What writing a trial and writing a candidate have in common."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded_trials.own_files import RESERVED, Meta, Target, Units
from grounded_trials.store import write_atomically


def with_meta(table: dict[str, str], meta: Meta) -> dict[str, str]:
    """The table with the entries of `meta`; a reserved one is refused."""
    for key, value in meta.items():
        if key in RESERVED:
            raise GroundedError(f"metadata '{key}' is written by grounded itself; use another name")
        table[key] = str(value)
    return table


def with_units(names: tuple[str, ...], units: Units | None) -> dict[str, str]:
    """Name -> unit for each name, "1" where none is known."""
    return {name: (units or {}).get(name, "1") for name in names}


def rows(values: Array, count: int, size: int) -> Array:
    """The values as doubles of shape (count, size), or a GroundedError."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (count, size):
        raise GroundedError(f"expected an array of shape {(count, size)}, got {array.shape}")
    return array


def deliver(target: Target, data: bytes) -> None:
    """Writes the bytes to a stream, or to a path at once."""
    if isinstance(target, str | Path):
        write_atomically(Path(target), data)
    else:
        target.write(data)
