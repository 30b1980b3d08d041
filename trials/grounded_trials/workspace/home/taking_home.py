"""export --model: the model as it is now, in the form that it came in.

A model of MuJoCo is written as its MJCF or URDF file, any other as its model.py. Comments, order
and layout of the file stay. A comment lists each value with its +-, and the date. What the form
can't hold is listed with its equation, there and as a finding.
"""

from __future__ import annotations

import ast
import datetime
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from grounded.adapters.files import files_of, load
from grounded.adapters.mujoco import MujocoStepper
from grounded.diagnosis.parts import Estimate
from grounded.effects import param_name
from grounded.errors import GroundedError
from grounded.findings import Finding, settle
from grounded.findings import found as finding
from grounded.result import Document
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.adopted import installed_effects
from grounded_trials.workspace.adoption import known_values
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.home.held import Held, Number, Value, value_of
from grounded_trials.workspace.home.mjcf import Mjcf, Urdf, XmlText, commented
from grounded_trials.workspace.user_files.model_file import load_module

FIRST = re.compile(r"(?:(?:#!.*|#.*coding.*)\n){0,2}")  # how to run and to read a Python file
WRITTEN = 1e-4  # relative difference of a value from the one that the written file compiles to


@dataclass(frozen=True, eq=False, repr=False)
class TakenHome(Document):
    """An exported model: its file, its numbers by name, and what the file can't hold."""

    file: Path
    source: Path
    date: str
    values: Mapping[str, Value]
    findings: tuple[Finding, ...]
    others: tuple[Path, ...] = ()  # files that it includes, written beside it


def export_model(workspace: Folder, path: str | Path | None = None) -> TakenHome:
    """Write the model as it is now, in the form that it came in, for other programs.

    An MJCF or URDF file, or a model.py, with the values of fitted parameters and of adopted
    effects; what the form can't hold is among the findings, with its equation.

    Args:
        workspace: the workspace.
        path: the file; None: named after the model's, in the current folder.

    Raises:
        GroundedError: if the model has no file, or `path` is that file or of another form.
    """
    model = workspace.base_model
    simulated = isinstance(model.step, MujocoStepper)
    source = model.step.source if isinstance(model.step, MujocoStepper) else _python_file(workspace)
    if source is None or not source.is_file():
        raise GroundedError(finding("model.other_form", workspace.base_model.name))
    path = Path(path or f"{source.stem}-found{source.suffix}")
    if path.suffix != source.suffix or path.resolve() == source:
        raise GroundedError(finding("model.other_form", str(path), source=source.name))
    return (_simulated if simulated else _python)(workspace, source, path)


def _simulated(workspace: Folder, source: Path, path: Path) -> TakenHome:
    """Write an MJCF or URDF file."""
    held = Held(workspace, known_values(workspace))
    lost = [_not_held(name, c) for name, c in held.lost]
    urdf = XmlText(source.read_bytes(), str(source)).root.tag == "robot"
    numbers = {one.name: one for one in held.numbers}
    while True:  # again without what the written file does not compile to
        date, comment = _comment(workspace, numbers, lost)
        form = Urdf(source) if urdf else Mjcf(source, held.file)
        for one in numbers.values():
            form.write(one)
        files = form.files(path, commented(comment))
        missed = _missed(source, path, files, [*numbers.values()])
        lost += [finding("model.no_place", n.name, value=numbers.pop(n.name).text) for n in missed]
        if not missed:
            break
    for name, data in files.items():
        write_atomically(name, data)
    if path.resolve().parent != source.parent:
        beside = [os.path.relpath(one, source.parent) for one in files_of(source)[1:]]
        lost += [finding("model.reads", *sorted(beside))] if beside else []
    others = tuple(name for name in files if name != path)
    return TakenHome(path, source, date, {**numbers}, settle(lost), others)


def _not_held(effect: str, c: Mapping[str, Estimate]) -> Finding:
    """Return the finding of an effect that a form can't hold: its equation with its values."""
    equation = installed_effects().family(effect.partition(":")[0]).equation
    values = tuple(f"{q} = {one.text}" for q, one in c.items() if q != "width")
    return finding("model.no_place", effect, equation=equation, values=values)


def _missed(
    source: Path, path: Path, files: Mapping[Path, bytes], numbers: Sequence[Number]
) -> list[Number]:
    """Return the numbers that the written files do not compile to, tried in a folder of its own."""
    read = [one.resolve() for one in files_of(source)]
    top = Path(os.path.commonpath([one.parent for one in read]))
    with tempfile.TemporaryDirectory() as place:
        for one in read:
            copy = Path(place) / one.relative_to(top)
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(one, copy)
        folder = Path(place) / source.parent.relative_to(top)
        for name, data in files.items():
            (folder / name.name).write_bytes(data)
        compiled = load(folder / path.name)
    apart = [abs(value_of(compiled, n.kind, n.index, n.field) - n.value) for n in numbers]
    return [n for n, far in zip(numbers, apart, strict=True) if far > WRITTEN * abs(n.value)]


def _python_file(workspace: Folder) -> Path | None:
    """Return the file of a model that Python defines."""
    table = workspace.config.model
    named = load_module(workspace.folder, table.file, table.module).__file__
    return Path(named).resolve() if named else None


def _python(workspace: Folder, source: Path, path: Path) -> TakenHome:
    """Write a model.py."""
    values, written = known_values(workspace), workspace.origin.model.params
    changed = {
        name: values[name] for name, param in written.items() if values[name].value != param.value
    }
    text, hidden = with_values(source, {name: one.value for name, one in changed.items()})
    taken = {
        name: Value(one.value, one.std, one.unit, written[name].value)
        for name, one in changed.items()
        if name not in hidden
    }
    told = [finding("model.no_place", n, value=changed[n].text) for n in hidden]
    for name, own in workspace.config.model.effects.items():
        told.append(_not_held(name, {q: values[param_name(name, q)] for q in own}))
    date, comment = _comment(workspace, taken, told)
    first = FIRST.match(text)
    head = first[0] if first else ""
    lines = "".join(f"# {line}".rstrip() + "\n" for line in comment)
    write_atomically(path, f"{head}{lines}{text[len(head) :]}".encode())
    return TakenHome(path, source, date, taken, settle(told))


def _comment(
    workspace: Folder, values: Mapping[str, Value], told: Sequence[Finding]
) -> tuple[str, list[str]]:
    """Return the date, and the lines of the comment that goes into the file."""
    date = datetime.datetime.now(tz=datetime.UTC).date().isoformat()
    lines = [f"grounded, {date}: values found in {workspace.folder.resolve().name}"]
    lines += [f"{name} = {one.text} (was {one.was:g})" for name, one in values.items()]
    return date, lines + [one.what for one in told]


def with_values(path: Path, values: Mapping[str, float]) -> tuple[str, list[str]]:
    """Return a model file with other values of its parameters, and the names it does not show.

    A parameter stands as `"L": Param(0.17, ...)` or `params=dict(L=Param(...))`; the expression of
    its value is replaced by the number.
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
