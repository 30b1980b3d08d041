"""What a kernel is called with: a table of 64-bit words, and room for its results.

The words are addresses, integers, doubles. What a problem gives every kernel is packed once and
kept beside the problem (`packed`); a call adds its own (`table`).
"""

from __future__ import annotations

import ctypes
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from grounded.compile.kernel_words import Layout
from grounded.compile.problem import Problem
from grounded.frozen import Array

Table = ctypes.Array[ctypes.c_int64]


@dataclass(frozen=True, eq=False)
class Packed:
    """A problem as words, its arrays kept alive beside them."""

    words: dict[str, int]
    kept: tuple[Array, ...]
    layout: Layout
    kernels: dict[Any, Any] = field(default_factory=dict)  # by system, see `CompiledSystem`


def packed(problem: Problem) -> Packed:
    """The words of a problem, made when they are first asked for."""
    known: Packed | None = problem.__dict__.get("_packed")
    if known is None:
        known = problem.__dict__["_packed"] = _pack(problem)
    return known


def _pack(problem: Problem) -> Packed:
    queue, shift = problem.queue, problem.input_shift
    arrays = {
        "start": problem.z_start(),
        "p": problem.p,
        "bias": problem.bias,
        "shift": np.zeros_like(problem.input_target) if shift is None else shift,
        "target": problem.target,
        "weight": problem.state_weight,
        "input_target": problem.input_target,
        "R": problem.input_weight,
        "S": problem.change_weight,
        "low": problem.low,
        "high": problem.high,
        "now": queue.now,
        "past": queue.past,
    }
    kept = {name: plain(array) for name, array in arrays.items()}
    words = {name: word(array) for name, array in kept.items()}
    words |= {"dt": word(float(problem.dt)), "eps": word(float(problem.smoothing))}
    words["H"] = problem.horizon
    angles, prompt = (tuple(map(bool, some)) for some in (problem.angles, queue.now == 1.0))
    layout = Layout(problem.system.n, problem.depths, angles, prompt)
    return Packed(words, tuple(kept.values()), layout)


def table(names: Sequence[str], known: Mapping[str, int], values: Mapping[str, Any]) -> Table:
    """Words in the order of `names`: of `values`, else `known`, else 0 (a null pointer)."""
    return (ctypes.c_int64 * len(names))(
        *[word(values[name]) if name in values else known.get(name, 0) for name in names]
    )


def call(function: Any, names: Sequence[str], values: Mapping[str, Any]) -> int:
    """Calls a kernel with these words; arrays must be contiguous float64."""
    return run(function, table(names, {}, values))


def run(function: Any, words: Table) -> int:
    """Calls a kernel with its table, which outlives the call."""
    return int(function(ctypes.addressof(words)))


def word(value: Any) -> int:
    """An integer as it is, an array's address, a double's bits."""
    if type(value) is int:
        return value
    if isinstance(value, np.ndarray):
        return address(value) if value.size else int(value.ctypes.data)
    return int(struct.unpack("<q", struct.pack("<d", value))[0])


def address(array: Array) -> int:
    """Where an array's first element is."""
    if array.flags.writeable and array.size:  # a third of the time of the line below
        memory: Any = array
        return ctypes.addressof(ctypes.c_char.from_buffer(memory))
    return int(array.__array_interface__["data"][0])


def plain(array: Any) -> Array:
    """The array as a kernel reads it."""
    return np.ascontiguousarray(array, dtype=np.float64)


def side_by_side(shapes: Mapping[str, tuple[int, ...]]) -> tuple[dict[str, Array], dict[str, int]]:
    """Arrays of these shapes in one block, each on a cache line of its own, and their addresses."""
    places, size = dict[str, tuple[int, int]](), 0
    for name, shape in shapes.items():
        end = size + math.prod(shape)
        places[name] = (size, end)
        size = (end + 7) & -8
    block = np.empty(size)
    start = int(block.__array_interface__["data"][0])
    arrays = {name: block[a:b].reshape(shapes[name]) for name, (a, b) in places.items()}
    return arrays, {name: start + 8 * first for name, (first, _) in places.items()}
