"""grounded init: make a workspace from a log of your robot, from a model, or from an example."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from grounded.findings import found as finding
from grounded.result import listed
from grounded_cli.console.options import json_asked, misuse
from grounded_cli.console.terminal import (
    LABEL,
    field,
    names_in,
    next_line,
    progress,
    sentence,
    show,
    tell,
)
from grounded_trials import Workspace
from grounded_trials.formats.tables import Layout
from grounded_trials.logs.inspection.guess import Guess, estimating
from grounded_trials.starting.begin import Begun, begin
from grounded_trials.starting.blank import left_open
from grounded_trials.starting.examples import EXAMPLES

ALTERNATIVES = 8  # alternative signals listed for an unsure state or input


def init(
    folder: str | None,
    log: str | None,
    model: str | None,
    blank: bool,
    kind: str | None,
    inputs: str | None,
    columns: str | None,
    rate: float | None,
    dt: float | None,
    actuators: tuple[str, ...],
    yes: bool,
    example: str | None,
    list: bool,
) -> Iterator[Begun | dict[str, Any]]:
    """Make a workspace of a log, a model or an example."""
    if list:
        yield {"examples": {key: value.text for key, value in EXAMPLES.items()}}
        return show("\n".join(f"{key:15} {value.text}" for key, value in EXAMPLES.items()))
    if folder is None or [log is not None, example is not None, blank].count(True) != 1:
        raise misuse("DIR --from LOG", "DIR --example NAME", "DIR --blank --model FILE")
    of_logs: dict[str, Any] = {"--kind": kind, "--inputs": inputs, "--yes": yes}
    of_logs |= {"--columns": columns, "--rate": rate}
    if not log and (foreign := [key for key, given in of_logs.items() if given]):
        raise misuse("--from LOG", foreign[0], how="first")
    if example is not None and (model or dt):
        raise misuse("--example", "--model or --dt")
    if blank and model is None:
        raise misuse("--model FILE", "--blank", how="first")
    if log is not None:
        asked = None if yes or json_asked() or not sys.stdin.isatty() else _ask
        with progress(f"reading {log}"):
            about: Any = {"model": model, "kind": kind, "dt": dt}
            about["layout"] = Layout(tuple(names_in(columns)), rate or 0.0)
            begun = begin(Path(folder), log, inputs=names_in(inputs), ask=asked, **about)
        _with(folder, actuators)
        yield begun
        return _tell(begun)
    made = Workspace.create(folder, example=example, model=model, dt=dt)
    _with(folder, actuators)
    notes = left_open(made.base_model) if blank else ()
    of = {"model": model} if blank else {"example": example}
    yield {"workspace": folder, **of, "findings": [one.to_json() for one in notes]}
    _made(folder, f"{model or example}:")
    show(f"  grounded.toml, {'target.csv, drive.py' if blank else 'model.py, target.csv, real.py'}")
    tell(notes)
    where = f"cd {shlex.quote(folder)} && " * (folder != ".")
    show(f"\nnext: {where}grounded propose")


def _with(folder: str, actuators: Sequence[str]) -> None:
    """Begin with actuators of other workspaces."""
    if actuators:
        effects = Workspace(folder).begin_with(*actuators)
        tell([finding("model.adopted", *(str(effect["name"]) for effect in effects))], all_=True)


def _ask(guess: Guess) -> str:
    """Ask the user which signal of the log is a state or input; return its path, "" for none."""
    paths = [p for p in (guess.path, *guess.others) if p]
    show(f"\n{guess.name} {'is unsure' if guess.path else 'was not found'}")
    for reason in guess.reasons:
        show(f"  {reason.sentence}")
    for i, path in enumerate(paths, start=1):
        show(f"  {i}  {path}")
    first = "1" if guess.path else ""
    none = "- for none"
    answer = click.prompt(f"  a number, another message path, or {none}", default=first or "-")
    if answer == "-":
        return ""
    return paths[int(answer) - 1] if answer.isdigit() and 0 < int(answer) <= len(paths) else answer


def _made(folder: str, of: str) -> None:
    sentence(f"{folder} is a workspace for {of}")


def _tell(begun: Begun) -> None:
    what = f"{begun.kind}: {begun.why}" if begun.kind else begun.why
    _made(begun.workspace, begun.log)
    show(field("model", what, "  "))
    show(field("grid", f"{begun.dt:g} s, {begun.horizon} steps", "  "))
    show(field("target", begun.target, "  "))
    both, known = (*begun.states, *begun.inputs), estimating(begun.states)
    aligned = partial(field, indent="  ", width=max(LABEL, *(len(guess.name) for guess in both)))
    heads = {len(begun.states): "inputs", 0: "states"}
    for k, guess in enumerate(both):
        if k in heads:
            show(f"\n{heads[k]}")
        mark = "" if guess.sure else "UNSURE "
        none = f"{'no name' if guess.others else 'nothing'} in the log fits"
        show(aligned(guess.name, f"{mark}{guess.path or none}"))
        for reason in guess.reasons:
            show(aligned("", reason.sentence))
        if guess.others and not guess.sure:
            or_ = "or" if guess.path else "perhaps"
            more = f" or {len(guess.others) - ALTERNATIVES} more" * (
                len(guess.others) > ALTERNATIVES
            )
            show(aligned("", f"{or_} {', '.join(guess.others[:ALTERNATIVES])}{more}"))
        if known and guess in begun.states and not guess.path:
            names = listed(one.name for one in known)
            show(aligned("", f"the smoother estimates it from {names} ([estimate])"))
    tell(begun.findings, all_=True)
    show(field("read", f"{begun.workspace}/model.py, {begun.workspace}/grounded.toml"))
    show(next_line(begun.then, begun.workspace))
