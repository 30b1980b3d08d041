"""Creates a workspace from a log, and reports what was found, what was guessed and why.

Nothing is decided silently: every signal is listed with its reasons and alternatives, every number
in grounded.toml that was taken from the log is marked as such, and uncertain signals are asked for
(in a terminal) or marked.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import known, refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Weight, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import heading
from grounded.result import NULL, UNSAID, Document
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.guess import Guess, mapping_toml
from grounded_trials.logs.inspection.inspect_log import LogReport, inspect_log
from grounded_trials.logs.inspection.names import PARTS
from grounded_trials.logs.log_paths import log_files
from grounded_trials.logs.log_table import log_mapping, read_log
from grounded_trials.starting.examples import fresh_folder
from grounded_trials.starting.first_toml import held_first, write_first
from grounded_trials.starting.kinds import (
    COMMANDED,
    KINDS,
    Clues,
    kind_in,
    skeleton,
    with_gain,
)
from grounded_trials.starting.own_model import own_model
from grounded_trials.starting.skeletons import Skeleton
from grounded_trials.store.own_files import format_of
from grounded_trials.store.store import write_atomically
from grounded_trials.toml_table import Table
from grounded_trials.workspace.user_files.config import FILE
from grounded_trials.workspace.user_files.model_file import load_module, model_in

NAMED = 5  # most columns named in an error
HORIZON = 200  # largest number of steps of a target taken from a recorded run
RATES = (1000, 500, 400, 250, 200, 125, 120, 100, 60, 50, 40, 30, 25, 20, 15, 10, 5, 2)  # [Hz]
STEPS = tuple(float(f"{1 / rate:.6g}") for rate in RATES)  # [s], rounded as written to files
GUESSED = 0.05  # [s], if nothing is known
ROUNDING = 0.03  # relative tolerance for rounding to one of STEPS
Ask = Callable[[Guess], str]


@dataclass(frozen=True, eq=False, repr=False)
class Begun(Document):
    """The result of making a workspace from a log."""

    ALSO = ("signals", "notes")

    workspace: str
    log: str
    kind: str = field(metadata=NULL)  # of the model skeleton; "" for the user's own model
    why: str  # why this kind was chosen
    dt: float  # [s]
    horizon: int
    states: tuple[Guess, ...] = field(metadata=UNSAID)
    inputs: tuple[Guess, ...] = field(metadata=UNSAID)
    target: str  # description of target.csv
    findings: tuple[Finding, ...] = ()

    @property
    def unsure(self) -> tuple[Guess, ...]:
        """The uncertain signals, which the user must check."""
        return tuple(g for g in (*self.states, *self.inputs) if not g.sure)

    @property
    def then(self) -> NextCommand:
        """The next command: ingest the log as data, or inspect it if an input is missing."""
        whole = all(g.path for g in self.inputs) and any(g.path for g in self.states)
        return NextCommand("ingest", ("--data", self.log)) if whole else self.look

    @property
    def look(self) -> NextCommand:
        """The command that lists the numbers of the log, for [log] in grounded.toml."""
        return NextCommand("inspect", (self.log,))

    def summary(self) -> str:
        """Return how many signals were found."""
        both = (*self.states, *self.inputs)
        return f"{self.workspace}: {sum(bool(g.path) for g in both)} of {len(both)} signals found"

    @property
    def signals(self) -> list[dict[str, Any]]:
        """What was found of each state and input."""
        return [
            {
                "name": guess.name,
                "path": guess.path or None,
                "sure": guess.sure,
                "reasons": [one.sentence for one in guess.reasons],
                "rivals": list(guess.others),
                "scale": guess.scale,
            }
            for guess in (*self.states, *self.inputs)
        ]


def begin(
    folder: Path,
    log: str | Path,
    *,
    model: str | Path | None = None,
    kind: str | None = None,
    dt: float | None = None,
    inputs: Sequence[str] = (),
    layout: Layout = AS_IT_SAYS,
    ask: Ask | None = None,
) -> Begun:
    """Create a workspace from a log; never overwrites a file.

    Args:
        folder: the workspace to create.
        log: a log in any format.
        model: the user's model.py, or an MJCF or URDF file; it is copied together with the files
            that it reads from its folder. None: a skeleton is written.
        kind: kind of the skeleton, see `KINDS`; None: guessed from the log.
        dt: control interval [s]; None: that of the commands in the log.
        inputs: names of the numbers that are inputs of a generic skeleton; empty: guessed.
        layout: the names and the rate of a table that does not say them; kept in [log].
        ask: called with each uncertain signal, returns the path to use; None: use the best guess.

    Raises:
        GroundedError: if the log can't be read or was written by grounded, if the folder already
            holds a workspace, or if a name is unknown.
    """
    if kind is not None:
        known("kind", [kind], KINDS)
    if inputs and (model is not None or kind not in (None, "generic")):
        raise refused("given.either", "--kind generic", "--inputs", how="first")
    own = own_model(model) if model is not None else None
    files = (FILE, "target.csv", *(own.missing(folder) if own else ("model.py",)))
    with fresh_folder(folder, files):
        # What the log has, and the model: the user's, or a skeleton of the kind of robot.
        logs, report, notes = _usable(log, layout)
        clues = Clues(report)
        if own:
            made, plain, drawn, why = own.bring(folder), None, "", "your model"
            found: Guesses = assigned(report, made.states, made.inputs, made)
        else:
            asked = "generic" if inputs else kind or ""
            drawn, why, plain, made, found = _skeleton(folder, clues, asked, inputs)
            notes += _of_generic(made, clues) if drawn == "generic" else ()

        # Which number is which signal, and in which units.
        units = {**made.states, **made.inputs}
        states, commands = ([_asked(g, ask, report, units) for g in some] for some in found)
        signals = {g.name: g for g in (*states, *commands)}
        if plain is not None and (full := with_gain(plain, signals, report)) is not plain:
            made = _written(folder, full)

        # The control interval, and the ranges: zero is sent after a run, so limits must include it.
        step = dt or _interval_of(report, commands, states)
        made = own.in_step(folder, made, step) if own else made
        ranges = {name: g.extent for name, g in signals.items()}
        for g in commands:
            if (seen := ranges[g.name]) is not None:
                ranges[g.name] = min(seen[0], 0.0), max(seen[1], 0.0)

        # The files: the target is read from the log as its [log] table says.
        table = mapping_toml(states, commands, simulated=report.simulated, layout=layout)
        columns, sent, odd_run = _recorded(logs, tomllib.loads(table), made, states, step)
        horizon, name = len(next(iter(columns.values()))) - 1, Path(log).name
        stood = held_first(made, columns, sent, step)
        write_first(folder, made, step, columns, ranges, table, why, name, stood)
        more = [*_on_own(report, (*states, *commands), made)] if own else []
        return Begun(
            workspace=str(folder),
            log=str(log),
            kind=drawn,
            why=why,
            dt=step,
            horizon=horizon,
            states=tuple(states),
            inputs=tuple(commands),
            target=f"{horizon * step:.3g} s of the log" if sent else "zeros",
            findings=(*notes, *more, *odd_run),
        )


Guesses = tuple[Sequence[Guess], Sequence[Guess]]  # of the states, of the inputs


def _skeleton(
    folder: Path, clues: Clues, asked: str, named: Sequence[str]
) -> tuple[str, str, Skeleton, Model, Guesses]:
    """Write the skeleton of a kind, of the generic one if a guessed kind has no state of the log.

    Returns:
        The kind and why, the skeleton, its model, and the numbers that its signals are taken from.
    """
    kind, why = (asked, "--kind") if asked else kind_in(clues)
    while True:
        plain = skeleton(kind, clues, named)
        model, generic = _written(folder, plain), kind == "generic"
        given = {name: one.path for name, one in clues.found.items()} if generic else {}
        found = assigned(clues.log, model.states, model.inputs, model, given)
        if asked or generic or any(g.path for g in found[0]):
            guessed = generic and not named
            why += f"; inputs guessed, as by --inputs {','.join(model.inputs)}" * guessed
            return kind, why, plain, model, found
        kind, why = "generic", f"none of {kind}"


def _of_generic(model: Model, clues: Clues) -> tuple[Finding, ...]:
    """Return what a generic skeleton leaves out of the log, and what it does not know."""
    left = [n for n in clues.found if n not in {**model.states, **model.inputs}]
    odd = [found("start.unused", *left)] * bool(left)
    if not set(model.inputs) & set(clues.found):
        odd.append(found("given.no_input", "--inputs", what="command", weight=Weight.NOTE))
    if not any(p.value for name, p in model.params.items() if name.startswith("gain_")):
        odd.append(found("plan.without_effect", *model.input_names, file="model.py"))
    return tuple(odd)


def _written(folder: Path, plain: Skeleton) -> Model:
    """Write a skeleton as model.py and load it."""
    write_atomically(folder / "model.py", plain.source().encode())
    return model_in(load_module(folder, "model.py"))


def _usable(
    log: str | Path, layout: Layout
) -> tuple[tuple[Path, ...], LogReport, tuple[Finding, ...]]:
    """Return the files of a log, what is in it, and notes; refuse one that tells no motion."""
    files = log_files(log)
    if format_of(files[0]):
        raise refused("start.no_start", log, why="own")
    report = inspect_log(log, layout)
    if report.damage:
        raise GroundedError(report.damage)
    numbers = [field for field in report.numbers if field.low is not None]
    if not numbers:
        there = [field.path for field in report.numbers]
        raise refused("start.no_start", log, why="text", names=tuple(there[:NAMED]))
    if all(field.low == field.high for field in numbers):
        raise refused("start.no_start", log, why="still")
    return files, *_one_run(report)


def _one_run(report: LogReport) -> tuple[LogReport, tuple[Finding, ...]]:
    """Reduce a file of runs with the same columns to its first run, with a note."""
    runs = [t for t in report.topics if t.type.startswith(("npz", "mat"))]
    columns = {tuple(f.path.removeprefix(t.topic) for f in t.fields) for t in runs}
    same = [t for t in runs if len(t.fields) == max(len(c) for c in columns)] if columns else []
    if len(same) < 2:
        return report, ()
    note = found("start.unused", *(t.topic for t in same[1:]))
    return replace(report, topics=(same[0],)), (note,)


def _on_own(report: LogReport, guesses: Sequence[Guess], model: Model) -> Iterator[Finding]:
    """Yield what the user's own model and the log lack of each other."""
    used = {guess.path for guess in guesses}
    if left := [path for path in report.moving if not (path in used or PARTS.search(path))]:
        more = [f"{len(left) - NAMED} more"] * (len(left) > NAMED)
        yield found("start.unused", *left[:NAMED], *more)
    if (name := heading(model)) and name not in model.angles:
        yield found("start.angles", name, declared=(*model.angles, name))
    if without := getattr(model.step, "without", ()):
        yield found("start.unmoved", *without)


def _interval_of(report: LogReport, inputs: Sequence[Guess], states: Sequence[Guess]) -> float:
    """Estimate the control interval of a log [s]."""
    rivals = [next((p for p in g.others if COMMANDED.search(p.lower())), "") for g in inputs]
    sent = [one.path or rival for one, rival in zip(inputs, rivals, strict=True)]
    for paths in (sent, [one.path for one in states]):
        topics = [report.topic_of(path) for path in paths]
        rates = [topic.rate_hz for topic in topics if topic is not None and topic.rate_hz > 0]
        if rates:
            return _rounded(1 / min(rates))
    return GUESSED


def _rounded(rows: float) -> float:
    """Round the interval of a log's rows [s] to a usual rate, else to whole Hz or ms.

    It is at least the smallest of `STEPS`. Slow processes are logged every few seconds.
    """
    usual = min(STEPS, key=lambda step: abs(np.log(step / rows)))
    if abs(usual / rows - 1) < ROUNDING or not STEPS[0] < rows:
        return usual
    whole = 1e-3 * max(round(1e3 * rows), 1), 1 / max(round(1 / rows), 1)
    nearest = min(whole, key=lambda step: abs(step - rows))
    return float(f"{nearest if abs(nearest / rows - 1) < ROUNDING else rows:.6g}")


def _asked(guess: Guess, ask: Ask | None, report: LogReport, units: Mapping[str, str]) -> Guess:
    """Return an unsure guess as the user answers."""
    if guess.sure or ask is None:
        return guess
    path = ask(guess)
    if path == guess.path:
        return replace(guess, sure=bool(path))
    scale = report.factor(path, units[guess.name]) if path else 1.0
    why = (found("start.given", guess.name),)
    field, clock = report.number(path), report.clock(report.topic_of(path))
    return Guess(guess.name, path, clock, bool(path), guess.others, field, why, scale)


def _recorded(
    files: Sequence[Path],
    tables: Mapping[str, Any],
    model: Model,
    states: Sequence[Guess],
    dt: float,
) -> tuple[dict[str, Array], dict[str, Array], tuple[Finding, ...]]:
    """Return the states (H + 1,) and inputs (H,) of a log's run, and what is odd about it.

    The run begins where `ingest --data` lets it begin. For one that can't be sampled a placeholder
    is returned.
    """
    from grounded_trials.workspace.intake.opening.foreign import rates_of  # slow

    measured = [guess.name for guess in states if guess.path]
    log = Table(tables["log"], Path(FILE), "log")
    try:
        mapping = log_mapping(log, model.state_names, model.input_names)
        if mapping is None or not measured:
            raise refused("given.no_input", "the log", what="state")
        rest, rates = np.zeros(len(mapping.inputs)), rates_of(model)
        how: dict[str, Any] = {"angles": model.angles, "rest": rest, "rates": rates}
        grid = read_log(files, mapping, dt, states=measured, steps=HORIZON, **how)
    except GroundedError as error:
        zeros = {model.state_names[0]: np.zeros(HORIZON + 1)}
        return zeros, {}, (error.finding.weighing(Weight.NOTE),)
    columns = dict(zip(measured, grid.states.T, strict=True))
    return columns, dict(zip(mapping.inputs, grid.inputs.T, strict=True)), grid.findings
