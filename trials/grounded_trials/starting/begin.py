"""Creates a workspace from a log, and reports what was found, what was guessed and why.

Nothing is decided silently: every signal is listed with its reasons and alternatives, every number
in grounded.toml that was taken from the log is marked as such, and uncertain signals are asked for
(in a terminal) or marked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from grounded.checks import known, refused
from grounded.errors import GroundedError, NextCommand
from grounded.findings import Finding, Weight, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import rate_states, undeclared_angles
from grounded.result import Result
from grounded_trials.formats.tables import AS_IT_SAYS, Layout
from grounded_trials.formats.text_tables import states_time_unit
from grounded_trials.logs.inspection.assignment import assigned
from grounded_trials.logs.inspection.guess import Guess
from grounded_trials.logs.inspection.guessed_table import mapping_toml
from grounded_trials.logs.inspection.inspect_log import LogReport, inspect_log
from grounded_trials.logs.inspection.joint_names import joint_names, perhaps_degrees
from grounded_trials.logs.inspection.names import PARTS
from grounded_trials.logs.log_files import column_units, kind_of, log_files
from grounded_trials.logs.log_table import log_mapping, read_log
from grounded_trials.logs.stated_units import Stated
from grounded_trials.plain_file import unreadable
from grounded_trials.starting.examples import fresh_folder
from grounded_trials.starting.first_toml import held_first, write_first
from grounded_trials.starting.interval import interval_of, too_coarse
from grounded_trials.starting.kinds import (
    KINDS,
    by_encoders,
    kind_in,
    moving,
    skeleton,
)
from grounded_trials.starting.own_model import OwnModel, own_model
from grounded_trials.starting.pushed import with_gain
from grounded_trials.starting.skeletons import Skeleton
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.user_files.config import FILE
from grounded_trials.workspace.user_files.model_file import load_module, model_in

NONE: Mapping[str, Array] = {}  # no input was read
SLOWEST = 0.5  # [Hz] smallest plausible row rate; below it, times may be in another unit
NAMED = 5  # most columns named in an error
HORIZON = 200  # largest number of steps of a target taken from a recorded run
Ask = Callable[[Guess], str]


@dataclass(frozen=True, eq=False, repr=False)
class Begun(Result):
    """The result of making a workspace from a log."""

    workspace: str
    log: str
    kind: str  # of the model skeleton; "" for the user's own model
    why: str  # why this kind was chosen
    dt: float  # [s]
    horizon: int
    states: tuple[Guess, ...]
    inputs: tuple[Guess, ...]
    target: str  # description of target.csv
    start: str = ""  # description of [task] start
    findings: tuple[Finding, ...] = ()
    again: tuple[str, ...] = ()  # arguments of `init` once the log's time column is renamed

    @property
    def unsure(self) -> tuple[Guess, ...]:
        """The uncertain signals, which the user must check."""
        return tuple(g for g in (*self.states, *self.inputs) if not g.sure)

    @property
    def then(self) -> NextCommand:
        """The next command: ingest the log as data, or inspect it if an input is missing.

        It is `init` for another folder if the log's times seem to be in another unit.
        """
        if self.again:
            return NextCommand("init", self.again)
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

    def to_json(self) -> dict[str, Any]:
        """Return the document of `init --from --json`."""
        signals = [
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
        return {
            "workspace": self.workspace,
            "log": self.log,
            "kind": self.kind or None,
            "why": self.why,
            "dt": self.dt,
            "horizon": self.horizon,
            "signals": signals,
            "target": self.target,
            "notes": [one.sentence for one in self.findings],
            "findings": [one.to_json() for one in self.findings],
        }


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
        dt: control interval [s]; None: the interval at which commands change, see `interval_of`.
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
    options = {"--model": model, "--kind": kind, "--dt": dt, "--inputs": ",".join(inputs)}
    options |= {"--columns": ",".join(layout.columns), "--rate": layout.rate}
    given = [str(part) for key, value in options.items() if value for part in (key, value)]
    again = (f"{folder}-2", "--from", str(log), *given)
    with fresh_folder(folder, files):
        kind = "generic" if inputs else kind
        return _begin(folder, log, own, kind, dt, inputs, layout, ask, again)


def _begin(
    folder: Path,
    log: str | Path,
    own: OwnModel | None,
    kind: str | None,
    dt: float | None,
    named: Sequence[str],
    layout: Layout,
    ask: Ask | None,
    again: tuple[str, ...],
) -> Begun:
    # What the log has, and the model: the user's, or a skeleton of the kind of robot.
    files, report, notes = _usable(log, layout)
    joints, stated = joint_names(report), column_units(files[0])
    chosen, why = (kind, "--kind") if kind else kind_in(report, joints)
    plain = None if own else skeleton(chosen, report, joints, named, stated)
    if own:
        why = "your model"
    built = own.bring(folder) if own else _model_in(folder, plain)
    matched = assigned(report, built.states, built.inputs, built, joints)
    if plain and not (kind or any(g.path for g in matched[0])):
        why = f"none of {chosen}"
        chosen, plain = "generic", skeleton("generic", report, joints, named, stated)
        built = _model_in(folder, plain)
    if chosen == "generic" and not own:
        given = {name: one.path for name, one in moving(report).items()}
        matched = assigned(report, built.states, built.inputs, built, joints, given)
        driven = any(one.value for name, one in built.params.items() if name.startswith("gain_"))
        notes = (*notes, *_left_out(report, built), *_undriven(built) * (not driven))

    # Which number is which signal.
    states, inputs = map(list, matched)
    units = {**built.states, **built.inputs}
    if chosen == "balance" and not own:
        states = by_encoders(states, report, joints, built.params["r"].value)
    states, inputs = ([_asked(g, ask, report, units) for g in some] for some in (states, inputs))
    if plain is not None:
        full = with_gain(plain, {g.name: g for g in (*states, *inputs)}, report)
        built = built if full is plain else _model_in(folder, full)

    # Units, ranges and the control interval.
    ranges = {g.name: g.extent for g in (*states, *inputs)}
    odd = perhaps_degrees((*states, *inputs), built, joints)
    inputs = [g.because(odd[g.name], sure=False) if g.name in odd else g for g in inputs]
    slow = () if layout.rate or states_time_unit(files[0]) else _in_seconds(report)
    notes = (*notes, *slow, *(odd[g.name] for g in states if g.name in odd))
    step, note = (dt, too_coarse(report, inputs, dt)) if dt else interval_of(report, inputs, states)
    built = own.in_step(folder, built, step) if own else built
    if chosen != "drone":  # zero is sent after a run, so the limits must include it
        ranges |= {
            g.name: (min(r[0], 0.0), max(r[1], 0.0)) for g in inputs if (r := ranges[g.name])
        }
    notes = (*notes, *(_on_own(report, states, inputs, built) if own else ()))

    # The files: first without a target, since the log is read as grounded.toml says.
    rates = rate_states(built)
    simulated = report.simulated
    table = mapping_toml(states, inputs, simulated=simulated, rates=rates, layout=layout)

    stood: dict[str, float] | None = None

    def write(columns: Mapping[str, Array], rows: int, sent: Mapping[str, Array] = NONE) -> None:
        nonlocal stood
        name, stood = Path(log).name, held_first(built, columns, sent, step, ranges)
        held = stood or {}
        write_first(folder, built, step, columns, rows, ranges, table, why, name, held)

    write({built.state_names[0]: np.zeros(2)}, 1)
    target, horizon, more = _recorded(folder, files, built, states, step, write)
    return Begun(
        workspace=str(folder),
        log=str(log),
        kind="" if own else chosen,
        why=why,
        dt=step,
        horizon=horizon,
        states=tuple(states),
        inputs=tuple(inputs),
        target=target,
        start=_start(stood),
        findings=(*notes, *[one for one in (note,) if one], *more),
        again=again if slow else (),
    )


def _usable(
    log: str | Path, layout: Layout
) -> tuple[tuple[Path, ...], LogReport, tuple[Finding, ...]]:
    """Return the files of a log, what is in it, and notes; refuse one that tells no motion."""
    files = log_files(log)
    if kind_of(files[0]):
        raise refused("start.no_start", log, why="own")
    report = inspect_log(log, layout)
    if report.damage:
        raise unreadable(log, report.damage, then=NextCommand("recover", (str(log),)))
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


def _model_in(folder: Path, plain: Skeleton | None) -> Model:
    """Write a skeleton as model.py and load it."""
    assert plain is not None
    write_atomically(folder / "model.py", plain.source().encode())
    return model_in(load_module(folder, "model.py"))


def _left_out(report: LogReport, model: Model) -> tuple[Finding, ...]:
    """Return notes on the numbers that a generic skeleton leaves out, and on missing inputs."""
    left = [name for name in moving(report) if name not in {**model.states, **model.inputs}]
    odd = [found("start.unused", *reversed(left))] * bool(left)
    if not set(model.inputs) & set(moving(report)):
        odd.append(found("given.no_input", "--inputs", what="command", weight=Weight.NOTE))
    return tuple(odd)


def _undriven(model: Model) -> tuple[Finding, ...]:
    """Return that no input changes a state of a skeleton yet."""
    return (found("plan.without_effect", *model.input_names, file="model.py"),)


def _on_own(
    report: LogReport, states: Sequence[Guess], inputs: Sequence[Guess], model: Model
) -> tuple[Finding, ...]:
    """Return notes on what the user's own model and the log lack of each other."""
    without = getattr(model.step, "without", ())
    unmoved = [found("start.unmoved", *without)] * bool(without)
    unused = _unused(report, (*states, *inputs))
    return (*unused, *_turning(model), *unmoved)


def _unused(report: LogReport, guesses: Sequence[Guess]) -> tuple[Finding, ...]:
    """Return a note that names the changing numbers of which the model uses none."""
    used = {guess.path for guess in guesses}
    left = [f.path for f in reversed(moving(report).values()) if f.path not in used]
    left = [path for path in left if not PARTS.search(path)]
    more = [f"{len(left) - NAMED} more"] * (len(left) > NAMED)
    return (found("start.unused", *left[:NAMED], *more),) * bool(left)


def _turning(model: Model) -> tuple[Finding, ...]:
    """Return a note on states that are angles by the model's equations, but not declared so."""
    if not (names := undeclared_angles(model)):
        return ()
    return (found("start.angles", *names, declared=(*model.angles, *names)),)


def _in_seconds(report: LogReport) -> tuple[Finding, ...]:
    """Return a note for each table whose times seem to be in another unit than seconds."""
    slow = [t for t in report.topics if t.topic == "/csv" and 0 < t.rate_hz < SLOWEST]
    return tuple(found("start.interval", t.topic, apart=1 / t.rate_hz) for t in slow)


def _asked(guess: Guess, ask: Ask | None, report: LogReport, units: Mapping[str, str]) -> Guess:
    """Return an unsure guess as the user answers."""
    if guess.sure or ask is None:
        return guess
    path = ask(guess)
    if path == guess.path:
        return replace(guess, sure=bool(path))
    scale = Stated.by(report.files).factor(path, units[guess.name]) if path else 1.0
    why = (found("start.given", guess.name, asked=True),)
    field, clock = report.number(path), report.clock(report.topic_of(path))
    return Guess(guess.name, path, clock, bool(path), guess.others, field, why, scale)


def _start(stood: Mapping[str, float] | None) -> str:
    """Say what [task] start holds."""
    return ", ".join(f"{name} = {value:.4g}" for name, value in (stood or {}).items()) or "empty"


def _recorded(
    folder: Path,
    files: Sequence[Path],
    model: Model,
    states: Sequence[Guess],
    dt: float,
    write: Callable[..., None],
) -> tuple[str, int, tuple[Finding, ...]]:
    """Write target.csv from the run in the log, or a placeholder if that can't be sampled.

    The run begins where `ingest --data` lets it begin, by which `logged_target` knows it again.
    """
    from grounded_trials.workspace.intake.opening.foreign import rates_of  # slow

    here = Folder(folder)
    measured = [guess.name for guess in states if guess.path]
    mapping = log_mapping(here.config.log, model.state_names, model.input_names)
    try:
        if mapping is None or not measured:
            raise refused("given.no_input", "the log", what="state")
        grid = read_log(
            files,
            mapping,
            dt,
            states=measured,
            angles=model.angles,
            steps=HORIZON,
            rest=np.zeros(len(mapping.inputs)),
            rates=rates_of(model),
        )
    except GroundedError as error:
        write({model.state_names[0]: np.zeros(HORIZON + 1)}, HORIZON)
        return "zeros", HORIZON, (error.finding.weighing(Weight.NOTE),)
    columns = dict(zip(measured, grid.states.T, strict=True))
    horizon = len(grid.states) - 1
    write(columns, horizon, dict(zip(mapping.inputs, grid.inputs.T, strict=True)))
    return f"{horizon * dt:.3g} s of the log", horizon, grid.findings
