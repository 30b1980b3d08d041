"""Read the tables of MATLAB files: version 5 (and 7) by SciPy, 7.3, which is HDF5, by h5py.

A struct with a column of times becomes a topic, `/run.q`, with its arrays of that length; so do the
arrays of the file itself, `/mat.q`. Structs inside it without times of their own use those. The two
forms in which Simulink stores plain signals are read as well: `time` with `signals.values`, and
`Time` with `Data`, as in structs that stand for `timeseries` and `logsout`. Objects of MATLAB's
own classes are not: their format is not documented.

Source: MathWorks, "MAT-File Format"; `scipy.io.matlab`; the attributes MATLAB_class of HDF5 files.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from grounded_trials.formats.messages import Floats
from grounded_trials.formats.tables import (
    AS_IT_SAYS,
    Columns,
    Layout,
    Tables,
    column_name,
    columns_by_name,
    is_time,
)
from grounded_trials.plain_file import unreadable

DATA = ("Data", "data", "values", "Values")  # the numbers of one signal beside its times
CALLED = ("Name", "name", "label", "blockName")  # what names it
NUMBERS, TEXT, REFERENCES = "fiub", "char", "O"


@dataclass(frozen=True)
class _Object:
    """A variable of one of MATLAB's own classes, which can't be read."""

    kind: str


def mat_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the tables of a MATLAB file of version 5; raises as `mat73_tables`."""
    from scipy.io import loadmat

    with warnings.catch_warnings():  # of two variables with one name the last counts
        warnings.simplefilter("ignore")
        content = loadmat(path, simplify_cells=True, appendmat=False)
    return _tables_in({k: _plain(v) for k, v in content.items() if k[:2] != "__"}, path, layout)


def mat73_tables(path: Path, layout: Layout = AS_IT_SAYS) -> Tables:
    """Return the tables of a MATLAB file of version 7.3."""
    import h5py

    with h5py.File(path, "r") as file:
        return _tables_in(_struct(file), path, layout)


def _tables_in(content: Mapping[str, Any], path: Path, layout: Layout) -> Tables:
    """Return the tables in nested dictionaries, lists, arrays and texts.

    With a rate, what has no times is as long as the longest array.
    """
    rows = max((max(a.shape) for a in map(_numbers, content.values()) if a is not None), default=0)
    outer = np.arange(rows) / layout.rate if layout.rate else None
    tables: Tables = {}
    for topic, clock, columns in _tables(content, ("mat",), outer, path):
        while topic in tables and not np.array_equal(next(iter(tables[topic].values())), clock):
            topic += "_"  # another clock in the same struct
        tables[topic] = {**tables.get(topic, {"time": clock}), **columns}
    objects = {name: one.kind for name, one in content.items() if isinstance(one, _Object)}
    if not tables and objects:
        why = f"{', '.join(objects)}: {', '.join(dict.fromkeys(objects.values()))}"
        raise unreadable(path, why, kind="MATLAB class")
    return tables


def _plain(value: Any) -> Any:
    """Return what SciPy read, with an `_Object` for each that it can't."""
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
        return [_plain(one) for one in value]
    if getattr(getattr(value, "dtype", None), "names", None):
        kind = value["s2"].item() if "s2" in value.dtype.names else ""
        return _Object(kind.decode() if isinstance(kind, bytes) else str(kind))
    return value


def _struct(group: Any) -> dict[str, Any]:
    """Return a group of an HDF5 file; links that lead out of it are not followed."""
    import h5py

    names = [name for name in group if not name.startswith("#")]
    inside = [n for n in names if isinstance(group.get(n, getlink=True), h5py.HardLink)]
    return {name: _node(group[name]) for name in inside}


def _node(node: Any) -> Any:
    """Return a variable of an HDF5 file: a struct, a cell array, a text or numbers."""
    import h5py

    kind = node.attrs.get("MATLAB_class", b"")
    kind = kind.decode() if isinstance(kind, bytes) else str(kind)
    if "MATLAB_object_decode" in node.attrs and kind != TEXT:
        return _Object(kind)
    if isinstance(node, h5py.Group):
        fields, bare = _struct(node), "MATLAB_class"  # that fields of an array of structs lack
        array = (isinstance(node[n], h5py.Dataset) and bare not in node[n].attrs for n in fields)
        if fields and all(array) and all(isinstance(one, list) for one in fields.values()):
            items = zip(*fields.values(), strict=False)
            return [dict(zip(fields, item, strict=True)) for item in items]
        return fields
    if node.external or node.is_virtual or "MATLAB_empty" in node.attrs:
        return None
    values = node[()]
    if np.asarray(values).dtype.kind == REFERENCES:
        return [_node(node.file[one]) for one in np.ravel(values) if one]
    if kind == TEXT:
        return "".join(map(chr, np.ravel(values)))
    return np.squeeze(np.transpose(values))  # its first dimension is MATLAB's last


def _tables(
    content: Any, at: tuple[str, ...], outer: Floats | None, path: Path
) -> Iterator[tuple[str, Floats, Columns]]:
    """Yield the tables in a struct, with topic and times: its own, then those inside."""
    if isinstance(content, list):
        content = {_called(one) or f"{at[-1]}{i}": one for i, one in enumerate(content)}
    elif isinstance(content, Mapping) and _called(content) != at[-1]:
        inside = content.get("Values")  # of a list of one
        content = {_called(content): inside} if isinstance(inside, Mapping) else content
    if not isinstance(content, Mapping):
        return
    arrays = {name: a for name, one in content.items() if (a := _numbers(one)) is not None}
    clocks = [name for name, a in arrays.items() if a.ndim == 1 and len(a) > 1 and is_time(name)]
    t = arrays[clocks[0]] if clocks else outer
    rest = {name: one for name, one in content.items() if name not in clocks[:1]}
    called = [part for part in at if part not in DATA]  # logsout.q.Values.Data is q of logsout
    if t is not None:
        columns = [
            (name in DATA, column)
            for name, one in (*rest.items(), *_signals(content))
            for column in _columns(called[-1] if name in DATA else name, _numbers(one), len(t))
        ]
        for alone in {alone for alone, _ in columns}:
            parts = called[1:-1] if alone else called[1:]
            named = columns_by_name((one for is_alone, one in columns if is_alone == alone), path)
            yield "/" + "/".join(parts or called[:1]), t, named
    for name, one in rest.items():
        if isinstance(one, Mapping | list) and name != "signals":
            yield from _tables(one, (*at, column_name(name)), t, path)


def _signals(content: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield the signals of Simulink's "structure with time", by their labels."""
    some = content.get("signals")
    for i, one in enumerate(some if isinstance(some, list) else [some]):
        if isinstance(one, Mapping) and "values" in one:
            yield _called(one) or f"signal{i + 1}", one["values"]


def _called(one: Any) -> str:
    """Return what a signal says to be its name, "" if nothing: the last part of a block's path."""
    if not isinstance(one, Mapping):
        return ""
    names = [one[key] for key in CALLED if isinstance(one.get(key), str) and one[key].strip()]
    return names[0].rpartition("/")[2] if names else ""


def _numbers(one: Any) -> Floats | None:
    """Return an array of numbers with one or two dimensions, or more of which two are not 1."""
    a = np.squeeze(np.asarray(one)) if isinstance(one, np.ndarray) else np.zeros(0)
    return a.astype(float) if a.dtype.kind in NUMBERS and 0 < a.ndim <= 2 and a.size else None


def _columns(name: str, a: Floats | None, rows: int) -> Iterator[tuple[str, Floats]]:
    """Yield the columns of an array (N, k), (N,) or (k, N), by name."""
    bare = column_name(name)
    if a is not None and a.shape == (rows,):
        yield bare, a
    elif a is not None and rows in a.shape:
        for i, column in enumerate((a if len(a) == rows else a.T).T):
            yield f"{bare}[{i}]", column
