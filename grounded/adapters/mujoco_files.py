"""Load an MJCF or URDF file, and list the files it uses: includes, meshes, textures."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

from grounded.adapters.beside import located, remember
from grounded.adapters.stepper import library
from grounded.checks import refused


def load(xml: Any) -> Any:
    """Return the compiled file (an MjModel) of a path or of MJCF text; a compiled one as it is.

    Raises:
        GroundedError: if the file is missing or MuJoCo can't load it, with MuJoCo's reason.
    """
    mj = library("mujoco")
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
    """Return the file and all files it uses, as far as MuJoCo lists them.

    MuJoCo does not list the meshes of a URDF, nor, before version 3.3, those of an MJCF file: they
    are looked up where MuJoCo looks for them.

    Args:
        path: an MJCF or URDF file that MuJoCo can load.
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
