"""Find files that a model.py names, relative to the model.py itself.

A workspace's model.py may call `mujoco.model("arm.xml")`, while commands run in any folder
(`-C DIR`) and workspaces are moved. While a model.py is loaded, a relative path is looked up beside
it first, then in the current folder. `recorded` lists the files that were read, so that they can be
copied to a new workspace.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

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
    """Add files to those recorded by `recorded`, if it is active.

    Args:
        named: the path as written in the model.py.
        files: returns all files that belong to it; called only if `recorded` is active.
    """
    if (read := _READ.get(None)) is not None:
        root = os.path.abspath(_root(named))  # noqa: PTH100 (links are kept as they are)
        every = (os.path.abspath(file) for file in files(located(named)))  # noqa: PTH100
        read += [(Path(root), Path(file)) for file in every]


def _root(path: str | Path) -> Path:
    folder = _FOLDER.get(None)
    return folder if folder and (folder / path).exists() else Path()
