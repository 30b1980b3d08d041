"""Load the user's model.py, the only code in a workspace that is imported.

An exception in it is the user's to fix and becomes a message with file and line.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
import traceback
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

from grounded.adapters.files import beside
from grounded.checks import of_type, refused, unknown, wrong
from grounded.errors import GroundedError
from grounded.foreign import contained
from grounded.model import Model
from grounded.trusted import check_own
from grounded_trials.workspace.user_files.config import FILE


def load_module(
    folder: Path, file: str = "", module: str = "", key: str = "[model] file"
) -> ModuleType:
    """Load the module of a model, from a file in the workspace or by its import name.

    A name may be one among the entry points; `key` is that of grounded.toml, for messages.
    """
    if module:
        check_own(folder, [folder / FILE])
        return _installed(module)
    path = (folder / file).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise wrong(f"grounded.toml: {key}", file, must="inside")
    if not path.is_file():
        raise refused("file.missing", path, where=f"grounded.toml: {key}")
    executed = [folder / FILE, path, path.parent / "__pycache__"]
    for place in path.parents:
        if place.is_relative_to(folder.resolve()):
            executed.append(place)
    check_own(folder, executed)
    spec = importlib.util.spec_from_file_location(f"grounded_workspace_{path.stem}", path)
    assert spec is not None and spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    before, writes = set(sys.modules), sys.dont_write_bytecode
    sys.dont_write_bytecode = True  # its times have 1 s resolution: a quick edit would be missed
    sys.path.insert(0, str(folder))
    sys.modules[spec.name] = found  # dataclasses look their module up there
    try:
        # a model's prints must not mix with our output; files it reads are relative to its folder
        with contextlib.redirect_stdout(sys.stderr), beside(path.parent), _running(str(path)):
            spec.loader.exec_module(found)
    finally:
        sys.dont_write_bytecode = writes
        sys.path.remove(str(folder))
        sys.modules.pop(spec.name, None)
        _forget_neighbours(folder, before)
    return found


def _installed(name: str) -> ModuleType:
    """Import a module by its name, or a model by its name among the entry points."""
    with _running(name):
        try:
            return importlib.import_module(name)
        except ModuleNotFoundError as error:
            if not f"{name}.".startswith(f"{error.name}."):  # what it imports is missing
                raise
    from importlib import metadata  # slow

    registered = {point.name: point for point in metadata.entry_points(group="grounded.models")}
    if name not in registered:
        raise unknown("module", name, registered, where="grounded.toml: [model] module")
    found = ModuleType(name)
    with _running(name):
        vars(found)["model"] = registered[name].load()
    return found


@contextlib.contextmanager
def _running(name: str) -> Iterator[None]:
    """Run the user's code, whose exceptions become messages with file and line."""
    try:
        with contained():
            yield
    except GroundedError as error:
        raise error.at(name) from None
    except Exception as error:
        raise _failed(error, name) from None


def _forget_neighbours(folder: Path, before: set[str]) -> None:
    """Unload modules imported from the model's folder: other workspaces have their own."""
    for name in set(sys.modules) - before:
        origin = getattr(sys.modules[name], "__file__", None)
        if origin and Path(origin).resolve().is_relative_to(folder.resolve()):
            del sys.modules[name]


def model_in(module: ModuleType) -> Model:
    """Return the `model` of a module."""
    found: Any = getattr(module, "model", None)
    if isinstance(found, Model):
        return found
    name = module.__file__ or module.__name__
    if found is None:
        names = [key for key, value in vars(module).items() if isinstance(value, Model)]
        raise refused("model.undefined", name, other=names[0] if names else None)
    of_type(f"{name}: `model`", found, Model)
    raise AssertionError(name)


def _failed(error: BaseException, name: str) -> GroundedError:
    """Return an error of the user's code, with the line of it that failed."""
    if isinstance(error, SyntaxError):
        return refused("model.fails", error.filename or name, line=error.lineno, why=error.msg)
    frames = [f for f in traceback.extract_tb(error.__traceback__) if Path(f.filename).name in name]
    line = frames[-1].lineno if frames else None
    return refused("model.fails", name, line=line, why=f"{type(error).__name__}: {error}")
