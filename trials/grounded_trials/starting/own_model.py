"""Copies the user's own model into a workspace: model.py and the files that it reads.

For an MJCF or URDF file, a model.py that loads it is written. Files that a model reads from its own
folder are copied to the same relative place in the workspace, so that it can be moved; files
elsewhere are not copied.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from grounded.adapters import mujoco
from grounded.adapters.files import beside, recorded
from grounded.checks import refused
from grounded.errors import GroundedError
from grounded.model import Model
from grounded_trials.plain_file import unreadable
from grounded_trials.store.store import made_folder, write_atomically
from grounded_trials.workspace.user_files.model_file import load_module, model_in

DIVIDES = 1e-3  # of dt: a timestep this near to a part of it divides it
SIMULATED = (".xml", ".urdf", ".mjcf")  # suffixes of files that MuJoCo loads
FILE = "model.py"
LOADS = """from grounded.adapters import mujoco

model = mujoco.model({name}{without}){remark}
"""
STAYS = "  # not copied: it reads files outside its folder"
MOVED = """
# params= names the parameters that `fit` and `diagnose` may change, with their bounds:
# model = mujoco.model({name}{without}, params={{{body}: ({low:.3g}, {high:.3g})}})
# others: the damping, frictionloss, armature of a joint, the gear of an actuator ...
"""


@dataclass(frozen=True, eq=False)
class OwnModel:
    """A model file that is to be copied into a workspace."""

    file: Path  # the file that the user named
    model: Model
    source: bytes  # contents of model.py
    others: Mapping[str, Path]  # other files to copy, by their relative path in the workspace
    outside: tuple[Path, ...]  # files that it reads from other folders

    def missing(self, folder: Path) -> tuple[str, ...]:
        """Return the names of the files that a folder does not have yet."""
        files = {FILE: self.file, **self.others}
        return tuple(name for name, path in files.items() if not _there(folder / name, path))

    def bring(self, folder: Path) -> Model:
        """Write the missing files to a folder, and load the model from there."""
        for name in self.missing(folder):
            made_folder((folder / name).parent)
            data = self.source if name == FILE else self.others[name].read_bytes()
            write_atomically(folder / name, data)
        try:
            return model_in(load_module(folder, FILE))
        except GroundedError as error:
            raise unreadable(folder / FILE, error, outside=tuple(map(str, self.outside))) from None

    def in_step(self, folder: Path, model: Model, dt: float) -> Model:
        """Return a simulated model whose timestep divides dt, which model.py then states."""
        own = float(getattr(model.step, "timestep", 0.0)) * (self.file.suffix.lower() in SIMULATED)
        if not own or abs(round(dt / own) * own - dt) <= DIVIDES * dt:
            return model
        said = f", timestep={dt / max(1, round(dt / own)):.12g})"
        text = (folder / FILE).read_text("utf-8")
        text = re.sub(r"^(model = .*?)\)", lambda m: m[1] + said, text, count=1, flags=re.M)
        write_atomically(folder / FILE, text.encode())
        return model_in(load_module(folder, FILE))


def own_model(file: str | Path) -> OwnModel:
    """Load the user's model: a Python file that defines `model`, or an MJCF or URDF file."""
    file = Path(file)
    if not file.is_file():
        raise refused("file.missing", file, where="--model")
    folder = file.resolve().parent
    with recorded() as read, beside(folder):
        if simulated := file.suffix.lower() in SIMULATED:
            model = mujoco.model(file.name, without="unmoved")
        else:
            model = model_in(load_module(folder, file.name, key="--model"))
    outside = tuple(dict.fromkeys(path for root, path in read if not path.is_relative_to(root)))
    others = {str(path.relative_to(root)): path for root, path in read if path not in outside}
    if simulated:  # loaded from its own folder if it reads files from elsewhere
        name, others = (str(folder / file.name), {}) if outside else (file.name, others)
        return OwnModel(file, model, _loads(model, file, name).encode(), others, outside)
    try:
        return OwnModel(file, model, file.read_bytes(), others, outside)
    except OSError as error:
        raise unreadable(file, error) from None


def _loads(model: Model, file: Path, name: str) -> str:
    """Return the text of a model.py that loads the model's MJCF or URDF file under a name."""
    stepper, quoted = model.step, json.dumps(name, ensure_ascii=False)
    assert isinstance(stepper, mujoco.MujocoStepper)
    named = json.dumps(stepper.without, ensure_ascii=False)
    known = {"name": quoted, "without": f", without={named}" if stepper.without else ""}
    text = LOADS.format(**known, remark="" if name == file.name else STAYS)
    for body, mass in stepper.masses.items():
        if mass > 0:
            body = json.dumps(f"{body}.mass", ensure_ascii=False)
            return text + MOVED.format(**known, body=body, low=0.5 * mass, high=2 * mass)
    return text


def _there(path: Path, source: Path) -> bool:
    """Return whether `path` already is the source file, or (except model.py) a copy of it."""
    if not path.is_file() or path.name == FILE:
        return path.is_file() and path.samefile(source)
    return path.read_bytes() == source.read_bytes()
