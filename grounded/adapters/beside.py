"""Files that a model file names: found beside it, from whatever folder it is loaded.

A workspace's model.py says `mujoco.model("arm.xml")`; commands come from anywhere (`-C DIR`), and a
workspace may be moved. While a model file is being loaded, a relative path leads to the file beside
it; where there is none, to one in the current folder, as everywhere else. Who makes a workspace
asks what was read, to copy it.
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
    """Relative paths lead to files of this folder first."""
    before = _FOLDER.set(folder)
    try:
        yield
    finally:
        _FOLDER.reset(before)


@contextmanager
def recorded() -> Iterator[list[tuple[Path, Path]]]:
    """All files that models read meanwhile, and the folder that each was named from; absolute."""
    found: list[tuple[Path, Path]] = []
    before = _READ.set(found)
    try:
        yield found
    finally:
        _READ.reset(before)


def located(path: str | Path) -> Path:
    """The file that a path names."""
    return _root(path) / path


def remember(named: str | Path, files: Callable[[Path], Iterable[Path]]) -> None:
    """Adds to what is recorded.

    Args:
        named: the path that the model file has.
        files: what is read for it; asked only where somebody records.
    """
    if (read := _READ.get(None)) is not None:
        root = os.path.abspath(_root(named))  # noqa: PTH100 (links are kept as they are)
        every = (os.path.abspath(file) for file in files(located(named)))  # noqa: PTH100
        read += [(Path(root), Path(file)) for file in every]


def _root(path: str | Path) -> Path:
    folder = _FOLDER.get(None)
    return folder if folder and (folder / path).exists() else Path()
