"""run: hand a candidate to the real system and get a trial file back.

The real system is a command of the user (for a robot, another simulator), which gets the paths of
the candidate and of the trial that it must write; or it is simulated by a model in the workspace.
"""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from grounded.checks import known, refused, wrong
from grounded.errors import NextCommand
from grounded.findings import Finding, found
from grounded.plant import Noise, Plant
from grounded.result import UNSAID, Document
from grounded.trusted import check_own
from grounded_trials.store.store import made_folder
from grounded_trials.store.trial_file import write_trial
from grounded_trials.workspace.candidates.handover import Handed, checked_candidate
from grounded_trials.workspace.candidates.search_state import candidate_named
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.next_step import to_run
from grounded_trials.workspace.user_files.config import FILE
from grounded_trials.workspace.user_files.model_file import load_module, model_in

EXAMPLE = "python drive.py {candidate} {trial}"  # a command of [system]


@dataclass(frozen=True, eq=False, repr=False)
class Ran(Document):
    """A candidate that was run, and the file of its trial, to be ingested."""

    trial_file: Path
    candidate: str
    findings: tuple[Finding, ...] = ()  # on the candidate
    overridden: tuple[Finding, ...] = field(metadata=UNSAID, default=())  # reasons against it

    @property
    def then(self) -> NextCommand:
        """The command that ingests the trial."""
        return NextCommand("ingest", (str(self.trial_file),))


def run_candidate(
    workspace: Folder,
    candidate: str | None = None,
    *,
    anyway: bool = False,
    warn: Callable[[Finding], None] | None = None,
) -> Ran:
    """Run a candidate on [system] and write its trial to runs/cNNNN-K.mcap, to be ingested.

    The candidate is refused if its file was altered since it was proposed, or if it is void because
    [limits], [safety], the task or the model have changed.

    Args:
        workspace: the workspace.
        candidate: c0003, or `best`; None: the outstanding one.
        anyway: run it although it is void.
        warn: called with the finding of each check that is overridden, before the robot moves.
    """
    system, identity = workspace.config.system, candidate_named(workspace, candidate)
    handed = checked_candidate(workspace, identity, anyway=anyway)
    if warn is not None:
        for reason in handed.overridden:
            warn(found("plan.refused", identity, why=reason.sentence, anyway=True))
    path = _next_run(workspace.folder / "runs", identity)
    if system.command:
        _call(workspace, system.command, handed, path)
    elif system.model:
        _simulate(workspace, handed, path)
    else:
        then = to_run(workspace, identity, *(() if candidate is None else (candidate,)))
        raise refused("run.by_hand", workspace.candidate_path(identity), example=EXAMPLE, then=then)
    return Ran(path, identity, handed.findings, handed.overridden)


def simulated_plant(workspace: Folder) -> Plant:
    """Return the simulated system of [system] model."""
    system = workspace.config.system
    module = load_module(workspace.folder, file=system.model, key="[system] model")
    model = model_in(module)
    for kind, values in system.noise.items():
        for name in values:
            where = f"grounded.toml: [system.noise.{kind}]"
            known("state", [name], model.states, system.model, where)
    noise = Noise(**{kind: dict(values) for kind, values in system.noise.items()})
    try:
        latency = {str(k): float(v) for k, v in dict(getattr(module, "latency", {})).items()}
        substeps = int(getattr(module, "substeps", 5))
    except (TypeError, ValueError) as error:
        raise wrong(
            f"latency and substeps in {system.model}", got=str(error), must="plant"
        ) from None
    return Plant(model=model, latency=latency, noise=noise, substeps=substeps)


def _next_run(folder: Path, identity: str) -> Path:
    taken = [p.stem.rsplit("-", 1)[-1] for p in made_folder(folder).glob(f"{identity}-*.mcap")]
    number = max((int(t) for t in taken if t.isdigit()), default=0) + 1
    return folder / f"{identity}-{number}.mcap"


def _call(workspace: Folder, command: str, handed: Handed, path: Path) -> None:
    """Call the user's command; its stdout goes to stderr."""
    check_own(workspace.folder, [workspace.folder / FILE])
    file = workspace.bring_back(handed.candidate.id)
    words = {"{candidate}": str(file.resolve()), "{trial}": str(path.resolve())}
    if not all(word in command for word in words):
        raise wrong("[system] command", command, must="words", like=EXAMPLE)
    try:
        parts = shlex.split(command)
    except ValueError as error:
        raise wrong("[system] command", got=f"{command} ({error})", must="words") from None
    for word, text in words.items():
        parts = [part.replace(word, text) for part in parts]
    try:
        done = subprocess.run(parts, cwd=workspace.folder, stdout=2, check=False)
    except OSError as error:
        why = f"{parts[0]}: {error.strerror}"
        raise refused("run.command", command, why=why) from None
    if done.returncode != 0:
        kept = str(path) if path.exists() else None
        raise refused("run.command", shlex.join(parts), exit=str(done.returncode), kept=kept)
    if not path.exists():
        raise refused("run.command", shlex.join(parts), missing=str(path))


def _simulate(workspace: Folder, handed: Handed, path: Path) -> None:
    candidate, meta = handed.candidate, handed.meta
    task, plant = workspace.task, simulated_plant(workspace)
    start = dict(zip(task.model.state_names, map(float, task.start), strict=True))
    number = len(workspace.store.list()) + 1
    rng = np.random.default_rng([workspace.config.system.seed, number])
    trial = plant.run(candidate.policy, start, rng)
    write_trial(
        path,
        replace(trial, candidate=candidate.id),
        {
            "kind": "trial",
            "iteration": meta["iteration"],
            "alpha": meta["alpha"],
            "task": meta["task"],
            "system": f"simulated: {workspace.config.system.model}",
            "number": str(number),
        },
        policy=handed.data,
        state_units=dict(task.model.states),
        input_units=dict(task.model.inputs),
    )
