"""An MJCF or URDF file: loaded; and the files it is made of: what it includes, meshes, textures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from grounded.adapters.beside import located, remember
from grounded.adapters.stepper import library
from grounded.errors import GroundedError


def load(xml: str | Path) -> Any:
    """The compiled file (an MjModel).

    Raises:
        GroundedError: if the file is missing or MuJoCo refuses it, with MuJoCo's reason.
    """
    mj = library("mujoco")
    if str(xml).lstrip().startswith("<"):
        shown, path = "the MJCF text", None
    elif not (path := located(xml)).is_file():
        raise GroundedError(f"there is no MJCF or URDF file {xml}")
    else:
        shown = str(path)
    try:
        if path is None:
            return mj.MjModel.from_xml_string(str(xml).lstrip())
        compiled = mj.MjModel.from_xml_path(shown)
    except ValueError as error:
        raise GroundedError(f"MuJoCo can't load {shown}: {error}") from error
    remember(xml, files_of)
    return compiled


def files_of(path: Path) -> list[Path]:
    """The file and all that it names, as far as MuJoCo tells.

    Args:
        path: of an MJCF or URDF file that MuJoCo can load. Of a URDF MuJoCo lists no meshes: they
            are sought where it seeks them. Versions before 3.3 list none of an MJCF either.
    """
    mj = library("mujoco")
    listed = getattr(mj, "mju_getXMLDependencies", lambda name: [name])(str(path))
    files = {path: None} | dict.fromkeys(map(Path, listed))
    return [*files, *(mesh for mesh in _meshes(mj, path) if mesh not in files)]


def _meshes(mj: Any, path: Path) -> list[Path]:
    spec = mj.MjSpec.from_file(str(path))
    folder = path.parent / getattr(spec, "meshdir", "")
    named = [mesh.file for mesh in spec.meshes if mesh.file]
    return [file for name in named if (file := folder / name).is_file()]
