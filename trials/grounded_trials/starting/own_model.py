"""The user's own model, brought into a workspace: model.py and the files beside it that it reads.

An MJCF or URDF file is a model too: model.py is then written, two lines that load it. What a model
reads from its own folder is copied to the same place in the workspace, so that this can be moved;
what lies elsewhere can't be.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from grounded.adapters.beside import beside, recorded
from grounded.errors import GroundedError
from grounded.model import Model
from grounded.result import listed
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.model_file import load_module, model_in

SIMULATED = (".xml", ".urdf", ".mjcf")  # files that MuJoCo loads
FILE = "model.py"
LOADS = """from grounded.adapters import mujoco

model = mujoco.model({name}){remark}
"""
STAYS = "  # not copied: it reads files outside its folder"
MOVED = """
# What `fit` and `diagnose` may move is named in params=, with its bounds:
# model = mujoco.model({name}, params={{{body}: ({low:.3g}, {high:.3g})}})
# also the damping, frictionloss, armature of a joint, the gear of an actuator ...
"""


@dataclass(frozen=True, eq=False)
class OwnModel:
    """A model file as it is brought into a workspace."""

    file: Path  # that was named
    model: Model
    source: bytes  # of model.py
    others: Mapping[str, Path]  # what is copied with it, by its place in the workspace
    outside: tuple[Path, ...]  # what it reads that lies elsewhere

    def missing(self, folder: Path) -> tuple[str, ...]:
        """The files that are to be written to a folder: those that do not lie there already."""
        files = {FILE: self.file} | dict(self.others)
        return tuple(name for name, path in files.items() if not _there(folder / name, path))

    def bring(self, folder: Path) -> Model:
        """Writes what is missing of it, and loads it from there.

        Raises:
            GroundedError: if it does not load there.
        """
        for name in self.missing(folder):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            data = self.source if name == FILE else self.others[name].read_bytes()
            write_atomically(folder / name, data)
        try:
            return model_in(load_module(folder, FILE))
        except GroundedError as error:
            far = f" ({listed(map(str, self.outside))})" if self.outside else ""
            raise GroundedError(
                f"{self.file} loads where it lies, but not as a copy in {folder}: {error}. Make "
                f"{folder} yourself, put {self.file.name} there as {FILE} and beside it the files "
                f"that it reads{far}, then give --model {folder / FILE}"
            ) from None


def own_model(file: str | Path) -> OwnModel:
    """The model of a file: one that holds `model`, or an MJCF or URDF file.

    Raises:
        GroundedError: if there is no such file, or no model in it.
    """
    file = Path(file)
    if not file.is_file():
        raise GroundedError(
            f"{file} does not exist: --model names a Python file with `model`, or an MJCF or URDF "
            "file"
        )
    folder = file.resolve().parent
    with recorded() as read, beside(folder):
        if simulated := file.suffix.lower() in SIMULATED:
            from grounded.adapters import mujoco

            model = mujoco.model(file.name)
        else:
            model = model_in(load_module(folder, file.name, key="--model"))
    outside = tuple(dict.fromkeys(path for root, path in read if not path.is_relative_to(root)))
    others = {str(path.relative_to(root)): path for root, path in read if path not in outside}
    if simulated:  # what can't be copied whole stays where it is
        name, others = (str(folder / file.name), {}) if outside else (file.name, others)
        return OwnModel(file, model, _loads(folder / file.name, name).encode(), others, outside)
    try:
        return OwnModel(file, model, file.read_bytes(), others, outside)
    except OSError as error:
        raise GroundedError(f"{file} can't be read: {error.strerror}") from None


def _loads(file: Path, name: str) -> str:
    """The text of a model.py that loads an MJCF or URDF file by a name."""
    from grounded.adapters.mujoco_files import load

    compiled, quoted = load(file), json.dumps(name, ensure_ascii=False)
    masses = {compiled.body(i).name: float(compiled.body_mass[i]) for i in range(compiled.nbody)}
    text = LOADS.format(name=quoted, remark="" if name == file.name else STAYS)
    for body, mass in masses.items():
        if body and mass > 0:
            body = json.dumps(f"{body}.mass", ensure_ascii=False)
            return text + MOVED.format(name=quoted, body=body, low=0.5 * mass, high=2 * mass)
    return text


def _there(path: Path, source: Path) -> bool:
    """Whether a file is at its place: itself, or a copy of it."""
    if not path.is_file() or path.name == FILE:
        return path.is_file() and path.samefile(source)
    return path.read_bytes() == source.read_bytes()
