"""Memory for results, used again: the first touch of a page costs as much as ten control steps.

A solve of thousands of steps fills a megabyte. Taken from the system and given back each time, its
pages would be mapped and zeroed each time, which takes longer than the computation. So a block goes
to a shelf when the last array made of it is gone, and the next result of that size takes it down.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from grounded.compile.problem import Array

SMALL = 2**13  # doubles; below, the C library keeps its pages
MOST = 2**23  # doubles on the shelf

_shelf: dict[int, list[Array]] = {}  # free blocks by size


def empty(shape: tuple[int, ...]) -> Array:
    """An array whose values are not set, float64 and C-contiguous."""
    size = math.prod(shape)
    if size < SMALL:
        return np.empty(shape)
    return np.asarray(_Block(1 << (size - 1).bit_length(), shape), np.float64)


def zeros(shape: tuple[int, ...]) -> Array:
    """An array of zeros, float64 and C-contiguous."""
    array = empty(shape)
    array.fill(0.0)
    return array


def side_by_side(shapes: Mapping[str, tuple[int, ...]]) -> tuple[dict[str, Array], dict[str, int]]:
    """Arrays of these shapes in one block, each on a cache line of its own, and their addresses."""
    places, size = dict[str, tuple[int, int]](), 0
    for name, shape in shapes.items():
        end = size + math.prod(shape)
        places[name] = (size, end)
        size = (end + 7) & -8
    block = empty((size,))
    start = int(block.__array_interface__["data"][0])
    arrays = {name: block[a:b].reshape(shapes[name]) for name, (a, b) in places.items()}
    return arrays, {name: start + 8 * first for name, (first, _) in places.items()}


class _Block:
    """Owns memory that an array and its views look at; NumPy keeps it alive as their base."""

    def __init__(self, size: int, shape: tuple[int, ...]) -> None:
        try:
            self._memory = _shelf[size].pop()
        except (KeyError, IndexError):
            self._memory = np.empty(size)  # a page that is never touched takes no room
        self.__array_interface__: dict[str, Any] = dict(self._memory.__array_interface__)
        self.__array_interface__["shape"] = shape

    def __del__(self, shelf: dict[int, list[Array]] = _shelf, most: int = MOST) -> None:
        memory = getattr(self, "_memory", None)
        if memory is None:
            return
        blocks = shelf.setdefault(memory.size, [])
        if sum(size * len(kept) for size, kept in tuple(shelf.items())) + memory.size <= most:
            blocks.append(memory)
