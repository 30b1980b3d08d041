"""Writes the example workspaces: grounded.toml, model.py, real.py, target.csv."""

from __future__ import annotations

import inspect
import shutil
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from types import ModuleType

import numpy as np

from grounded.checks import known, refused
from grounded.task import Task
from grounded_trials.starting import template
from grounded_trials.starting.first_toml import inline, number
from grounded_trials.store.store import made_folder, sweep, write_atomically
from grounded_trials.toml_table import key
from grounded_trials.workspace.user_files.config import FILE
from grounded_trials.workspace.user_files.task_file import target_text


@dataclass(frozen=True)
class Example:
    """One example of `examples.toml`: its line in the list, and the sources of its files."""

    text: str
    model: str  # module of the crude model, copied to model.py
    real: str  # template of real.py
    tasks: str  # module and function (..., model) of its task
    arguments: Sequence[str] = ()

    def task(self) -> Task:
        """Return the task with the crude model."""
        module, _, name = self.tasks.rpartition(".")
        made: Task = getattr(import_module(module), name)(*self.arguments, self.module.model)
        return made

    @property
    def module(self) -> ModuleType:
        """The module of the crude model."""
        return import_module(self.model)


_TEXT = files(__package__).joinpath("examples.toml").read_text("utf-8")
EXAMPLES: Mapping[str, Example] = {
    name: Example(**given) for name, given in tomllib.loads(_TEXT).items()
}


def example(name: str) -> Example:
    """Return the example of a name."""
    known("example", [name], EXAMPLES)
    return EXAMPLES[name]


def write_example(folder: Path, name: str) -> None:
    """Write the workspace of an example; never overwrites a file."""
    chosen = example(name)
    task = chosen.task()
    columns = {
        state: task.target[:, i]
        for i, state in enumerate(task.model.state_names)
        if np.isfinite(task.target[:, i]).all()
    }
    files = {"target.csv": target_text(task.dt, columns), "model.py": _source(chosen.module)}
    files |= {"real.py": template(chosen.real), FILE: toml_of(task, name)}
    with fresh_folder(folder, files):
        for file, text in files.items():
            write_atomically(folder / file, text.encode())


@contextmanager
def fresh_folder(folder: Path, files: Iterable[str]) -> Iterator[None]:
    """Create the folders of a workspace, and clean up if the body of the `with` statement fails.

    On failure a new folder is removed; from an existing one only `files`, the names of those that
    the body writes, of which none may exist yet.
    """
    for path in (folder / name for name in files):
        if path.exists():
            raise refused("file.exists", path)
    new = not folder.exists()
    try:
        for made in (folder, folder / "trials", folder / "candidates"):
            made_folder(made)
        sweep(folder, 0.0)  # of an `init` that was killed: the folder is no workspace yet
        yield
    except BaseException:
        for path in [folder] if new else [folder / name for name in files]:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)
        raise


def _source(module: ModuleType) -> str:
    return f"# Copied from {module.__name__}: edit it freely.\n" + inspect.getsource(module)


SIMULATED = 'model = "real.py"             # robot: command = "python drive.py {candidate} {trial}"'


SYSTEM = "[system]                      # how `grounded run` reaches the real system"
SEARCH = """method = "ddp"                # or "policy-gradient"
step = "damped"               # as in the paper: "full", and match_inputs = false
repeats = 1                   # trials per candidate, averaged
rerun_incumbent = true        # repeat the best candidate after a loss within the noise
"""


def toml_of(task: Task, name: str, system: str = SIMULATED, *, explicit: bool = False) -> str:
    """Return the grounded.toml of a task, with comments.

    `name` is that of an example, or a line that says what it is; `system` stands under [system];
    `explicit`: the start is written where the target begins there too.
    """
    states, inputs = task.model.state_names, task.model.input_names
    given = np.isfinite(task.target[0]) & (not explicit)
    first = np.where(given, task.target[0], 0.0)
    start = {s: v for s, v, f in zip(states, task.start, first, strict=True) if v != f}
    start |= {i: v for i, v in zip(inputs, task.past, strict=True) if v != 0}
    assert task.latency is not None
    latency = {i: v for i, v in zip(inputs, task.latency, strict=True) if v > 0}
    reward = task.reward
    weights = {
        "state": dict(zip(states, reward.state, strict=True)),
        "terminal": dict(zip(states, reward.terminal, strict=True)),
        "input": dict(zip(inputs, reward.input, strict=True)),
        "input_change": dict(zip(inputs, reward.input_change, strict=True)),
    }
    limits = [
        f"{key(i)} = [{number(low)}, {number(high)}]"
        for i, low, high in zip(inputs, task.low, task.high, strict=True)
        if np.isfinite(low) and np.isfinite(high)
    ]
    lines = (f"{k} = {inline({n: w for n, w in v.items() if w})}" for k, v in weights.items())
    return template(FILE).format(
        title=f"{name}: {EXAMPLES[name].text}" if name in EXAMPLES else name,
        model=f"smoothing = {number(task.smoothing)}              # of np.where, abs ...\n",
        dt=number(task.dt),
        horizon=task.horizon,
        start=inline(start),
        feedback=str(task.feedback).lower(),
        latency=inline(latency),
        weights="\n".join(lines),
        limits="\n".join(limits),
        search=SEARCH,
        rest=f"{SYSTEM}\n{system}" + "\nseed = 0" * (system == SIMULATED),
    )
