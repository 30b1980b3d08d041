"""Writes values into a model.py: the numbers of its `Param(...)`, nothing else."""

from __future__ import annotations

import ast
from collections.abc import Iterator, Mapping
from pathlib import Path


def with_values(path: Path, values: Mapping[str, float]) -> tuple[str, list[str]]:
    """Return a model file with other values of its parameters, and the names it does not show.

    A parameter stands as `"L": Param(0.17, ...)` or `params=dict(L=Param(...))`; the expression of
    its value is replaced by the number.

    Args:
        path: the file.
        values: by name of the parameter.
    """
    source = path.read_bytes()
    lines = source.splitlines(keepends=True)
    starts = [sum(map(len, lines[:i])) for i in range(len(lines))]
    edits = dict[int, tuple[int, bytes]]()
    for name, value in _named(ast.parse(source)):
        if name in values and value.end_lineno and value.end_col_offset is not None:
            begin = starts[value.lineno - 1] + value.col_offset
            end = starts[value.end_lineno - 1] + value.end_col_offset
            edits[begin] = end, f"{values[name]:.8g}".encode()
            values = {n: v for n, v in values.items() if n != name}
    for begin, (end, new) in sorted(edits.items(), reverse=True):
        source = source[:begin] + new + source[end:]
    return source.decode(), list(values)


def _named(tree: ast.AST) -> Iterator[tuple[str, ast.expr]]:
    """Yield the names of parameters with the expressions of their values."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            keys = (getattr(key, "value", None) for key in node.keys)
            pairs = [(k, v) for k, v in zip(keys, node.values, strict=True) if isinstance(k, str)]
        elif isinstance(node, ast.Call):
            pairs = [(str(keyword.arg), keyword.value) for keyword in node.keywords]
        else:
            continue
        for name, call in pairs:
            if isinstance(call, ast.Call) and _called(call.func) == "Param":
                value = [k.value for k in call.keywords if k.arg == "value"] + call.args[:1]
                yield from ((name, one) for one in value[:1])


def _called(function: ast.expr) -> str:
    return getattr(function, "attr", getattr(function, "id", ""))
