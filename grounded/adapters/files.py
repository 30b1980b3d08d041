"""Find files that a model.py names, relative to the model.py itself.

A workspace's model.py may call `mujoco.model("arm.xml")`, while commands run in any folder
(`-C DIR`) and workspaces are moved. While a model.py is loaded, a relative path is looked up beside
it first, then in the current folder. `recorded` lists the files that were read, with those that an
MJCF or URDF file uses (includes, meshes, textures), so that they can be copied to a new workspace.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from grounded.checks import refused
from grounded.errors import needs

_FOLDER: ContextVar[Path | None] = ContextVar("the folder of the model file that is loaded")
_READ: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("what model files read")


@contextmanager
def beside(folder: Path) -> Iterator[None]:
    """Look up relative paths in this folder first, inside the block."""
    before = _FOLDER.set(folder)
    try:
        yield
    finally:
        _FOLDER.reset(before)


@contextmanager
def recorded() -> Iterator[list[tuple[Path, Path]]]:
    """Record the files that models read inside the block, as absolute (folder, file) pairs.

    The folder is the one that the model's relative path refers to.
    """
    found: list[tuple[Path, Path]] = []
    before = _READ.set(found)
    try:
        yield found
    finally:
        _READ.reset(before)


def located(path: str | Path) -> Path:
    """Return the file that a path in a model.py refers to."""
    return _root(path) / path


def remember(named: str | Path, files: Callable[[Path], Iterable[Path]]) -> None:
    """Add the `files` of a path in a model.py to those recorded by `recorded`, if it is active."""
    if (read := _READ.get(None)) is not None:
        root = os.path.abspath(_root(named))  # noqa: PTH100 (links are kept as they are)
        every = (os.path.abspath(file) for file in files(located(named)))  # noqa: PTH100
        read += [(Path(root), Path(file)) for file in every]


def _root(path: str | Path) -> Path:
    folder = _FOLDER.get(None)
    return folder if folder and (folder / path).exists() else Path()


def load(xml: Any) -> Any:
    """Return the compiled file (an MjModel) of a path or of MJCF text; a compiled one as it is."""
    mj = needs("mujoco")
    if isinstance(xml, mj.MjModel):
        return copy.deepcopy(xml)
    if str(xml).lstrip().startswith("<"):
        shown, path = "the MJCF text", None
    elif not (path := located(xml)).is_file():
        raise refused("file.missing", xml)
    else:
        shown = str(path)
    try:
        if path is None:
            return mj.MjModel.from_xml_string(str(xml).lstrip())
        compiled = mj.MjModel.from_xml_path(shown)
    except ValueError as error:
        raise refused("file.unreadable", shown, why=str(error), kind="MuJoCo model") from error
    remember(xml, files_of)
    return compiled


def files_of(path: Path) -> list[Path]:
    """Return an MJCF or URDF file and all files it uses, as far as MuJoCo lists them.

    MuJoCo does not list the meshes of a URDF, nor, before version 3.3, those of an MJCF file: they
    are looked up where MuJoCo looks for them.
    """
    mj = needs("mujoco")
    listed = getattr(mj, "mju_getXMLDependencies", lambda name: [name])(str(path))
    files = {path: None} | dict.fromkeys(map(Path, listed))
    return [*files, *(mesh for mesh in _meshes(mj, path) if mesh not in files)]


def _meshes(mj: Any, path: Path) -> list[Path]:
    spec = mj.MjSpec.from_file(str(path))
    folder = path.parent / getattr(spec, "meshdir", "")
    named = [mesh.file for mesh in spec.meshes if mesh.file]
    return [file for name in named if (file := folder / name).is_file()]
