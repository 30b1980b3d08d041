"""A workspace from a log: what it found, what it guessed and why, and what a person must decide.

Nothing is decided silently: every signal is listed with its reasons and its rivals, every number in
grounded.toml that was read off the log says so, and what is unsure is asked for (in a terminal) or
marked.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from grounded.errors import GroundedError, NextCommand, nearest
from grounded.frozen import Array
from grounded.model import Model
from grounded.result import Result
from grounded_trials.formats.text_tables import column_units
from grounded_trials.logs.inspect_evidence import as_stated, weigh
from grounded_trials.logs.inspect_guess import Guess, guess_mapping, is_simulated, mapping_toml
from grounded_trials.logs.inspect_log import LogReport, inspect_log
from grounded_trials.logs.inspect_pairs import velocities
from grounded_trials.logs.joint_names import joint_names, joint_units, wide_joints
from grounded_trials.logs.log_files import kind_of, log_files
from grounded_trials.logs.log_table import log_mapping, read_log
from grounded_trials.logs.stated_units import Stated
from grounded_trials.logs.unnamed import from_the_rest
from grounded_trials.starting.examples import fresh_folder
from grounded_trials.starting.first_toml import held_first, write_first
from grounded_trials.starting.interval import interval_of
from grounded_trials.starting.kinds import KINDS, Joints, called_input, kind_in, moving, skeleton
from grounded_trials.starting.own_model import OwnModel, own_model
from grounded_trials.store.store import write_atomically
from grounded_trials.workspace.config import FILE
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.model_file import load_module, model_in

NONE: Mapping[str, Array] = {}  # no input was read
SLOWEST = 0.5  # [Hz] rows of a robot's log: slower ones have times in another unit
HORIZON = 200  # steps of a target that is a recorded run, at most
Ask = Callable[[Guess], str]


@dataclass(frozen=True, eq=False, repr=False)
class Begun(Result):
    """A workspace made from a log."""

    workspace: str
    log: str
    kind: str  # of the model skeleton; "" for the user's own model
    why: str  # what says so
    dt: float  # [s]
    horizon: int
    states: tuple[Guess, ...]
    inputs: tuple[Guess, ...]
    target: str  # what target.csv holds
    notes: tuple[str, ...] = ()

    @property
    def unsure(self) -> tuple[Guess, ...]:
        """The signals that a person must look at."""
        return tuple(g for g in (*self.states, *self.inputs) if not g.sure)

    @property
    def then(self) -> NextCommand:
        """Take the log in, to fit and diagnose the model on it; where an input is missing, look."""
        whole = all(g.path for g in self.inputs) and any(g.path for g in self.states)
        return NextCommand("ingest", ("--data", self.log)) if whole else self.look

    @property
    def look(self) -> NextCommand:
        """What names the numbers of the log, for grounded.toml."""
        return NextCommand("inspect", (self.log,))

    def summary(self) -> str:
        """How much was matched."""
        both = (*self.states, *self.inputs)
        return f"{self.workspace}: {sum(bool(g.path) for g in both)} of {len(both)} signals found"

    def to_json(self) -> dict[str, Any]:
        """The document of `init --from --json`."""
        signals = [
            {
                "name": guess.name,
                "path": guess.path or None,
                "sure": guess.sure,
                "reasons": list(guess.reasons),
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
            "notes": list(self.notes),
        }


def begin(
    folder: Path,
    log: str | Path,
    *,
    model: str | Path | None = None,
    kind: str | None = None,
    dt: float | None = None,
    inputs: Sequence[str] = (),
    ask: Ask | None = None,
) -> Begun:
    """Makes a workspace from a log; an existing file is never overwritten.

    Args:
        folder: where it is made.
        log: of any format.
        model: the user's model.py, or an MJCF or URDF file, which is copied with what it reads
            beside it; None: a skeleton is written.
        kind: of the skeleton, see `KINDS`; None: as the log looks.
        dt: control interval [s]; None: that in which the commands of the log change, see
            `interval_of`.
        inputs: which numbers of the log are a generic skeleton's inputs; none: as they look.
        ask: given each unsure signal, returns the path to take; None: the best guess is taken.

    Raises:
        GroundedError: if the log can't be read or is ours, the folder holds a workspace, or a
            name is unknown.
    """
    if kind is not None and kind not in KINDS:
        raise GroundedError(f"there is no kind '{kind}': {nearest(kind, KINDS)}")
    if inputs and (model is not None or kind not in (None, "generic")):
        raise GroundedError("--inputs is for a skeleton of kind generic: others have their own")
    own = own_model(model) if model is not None else None
    files = (FILE, "target.csv", *(own.missing(folder) if own else ("model.py",)))
    with fresh_folder(folder, files):
        return _begin(folder, log, own, "generic" if inputs else kind, dt, inputs, ask)


def _begin(
    folder: Path,
    log: str | Path,
    own: OwnModel | None,
    kind: str | None,
    dt: float | None,
    named: Sequence[str],
    ask: Ask | None,
) -> Begun:
    files = log_files(log)
    if kind_of(files[0]):
        raise GroundedError(f"{log} was written by grounded itself: init needs a foreign log")
    report = inspect_log(log)
    if report.damage:
        raise GroundedError(report.damage, NextCommand("recover", (str(log),)))
    report, notes = _one_run(report)
    joints = joint_names(report)
    chosen, why = (kind, "as you said") if kind else kind_in(report, joints)
    if own:
        why, found = "your model", own.bring(folder)
    else:
        text = skeleton(chosen, report, joints, named, column_units(files[0])).source()
        found = _model_in(folder, text)
    states, inputs = _matched(report, found, joints, unnamed=not own)
    if not (kind or own or any(g.path for g in states)):
        why = f"no number of the log fits a state of kind {chosen}: the names are the log's"
        chosen = "generic"
        text = skeleton(chosen, report, joints, named, column_units(files[0])).source()
        found = _model_in(folder, text)
        states, inputs = _matched(report, found, joints)
    if chosen == "generic" and not own:
        states, inputs = (
            tuple(_only_named(g, of) for g in s) for s, of in ((states, "state"), (inputs, "input"))
        )
        notes = (*notes, *_left_out(report, found))
    units = {**found.states, **found.inputs}
    both = from_the_rest((*states, *inputs), units, report, joint_units(joints))
    states, inputs = both[: found.n], both[found.n :]
    if ask is not None:
        said = Stated.by(files)
        states, inputs = (
            tuple(_asked(g, ask, partial(as_stated, said, units[g.name])) for g in some)
            for some in (states, inputs)
        )
    notes = (*notes, *_in_seconds(report), *wide_joints(states, units, joints, report))
    step, whose, note = (dt, "", "") if dt else interval_of(report, inputs, states)
    ranges = {g.name: _range(report, g) for g in (*states, *inputs)}
    if chosen != "drone":  # what is sent after a run must be allowed: rest
        ranges |= {
            g.name: (min(r[0], 0.0), max(r[1], 0.0)) for g in inputs if (r := ranges[g.name])
        }
    table = mapping_toml(states, inputs, simulated=is_simulated(report))

    def write(columns: Mapping[str, Array], rows: int, sent: Mapping[str, Array] = NONE) -> None:
        name, held = Path(log).name, held_first(found, columns, sent, step, ranges)
        write_first(folder, found, (step, whose), columns, rows, ranges, table, why, name, held)

    write({found.state_names[0]: np.zeros(2)}, 1)
    target, horizon, more = _recorded(folder, files, found, states, step, write)
    return Begun(
        workspace=str(folder),
        log=str(log),
        kind="" if own else chosen,
        why=why,
        dt=step,
        horizon=horizon,
        states=states,
        inputs=inputs,
        target=target,
        notes=(*notes, *[note] * bool(note), *more),
    )


def _matched(
    report: LogReport, model: Model, joints: Joints, *, unnamed: bool = False
) -> tuple[tuple[Guess, ...], tuple[Guess, ...]]:
    """Where the states and inputs are; `unnamed`: a skeleton's, whose names the log need not know.

    Where no name fits a position and its rate, any two numbers may be they, of which one follows
    the derivative of the other; the one number that is left is the one input.
    """
    units = {**model.states, **model.inputs}
    names = guess_mapping(report, model.state_names, model.input_names, units)
    states, inputs = weigh(report, model, *names, joints)
    if not unnamed or any(g.path or g.others for g in states):
        return states, inputs
    found, taken = moving(report), {g.path for g in inputs}
    free = [f.path for f in reversed(found.values()) if f.path not in taken]
    sent = {f.path for name, f in found.items() if called_input(name, f.path)}
    others = tuple(path for path in free if path not in sent)
    pair = {name for both in velocities(model).items() for name in both}
    tried = tuple(replace(g, others=others) if g.name in pair else g for g in states)
    tried, inputs = weigh(report, model, tried, inputs, joints)
    pairs = zip(tried, states, strict=True)
    states = tuple(replace(g, sure=False, others=()) if g.path else old for g, old in pairs)
    rest = [path for path in free if path not in {g.path for g in states}]
    if all(g.path for g in states) and len(inputs) == len(rest) == 1 and not inputs[0].path:
        left = replace(inputs[0], path=rest[0], reasons=("the one number that is left",))
        _, (left,) = weigh(report, model, states, (left,), joints)
        inputs = (replace(left, sure=False),)
    return states, inputs


def _one_run(report: LogReport) -> tuple[LogReport, tuple[str, ...]]:
    """An archive of many runs with the same columns is looked at by its first one."""
    runs = [t for t in report.topics if t.type.startswith("npz")]
    columns = {tuple(f.path.removeprefix(t.topic) for f in t.fields) for t in runs}
    same = [t for t in runs if len(t.fields) == max(len(c) for c in columns)] if columns else []
    if len(same) < 2:
        return report, ()
    note = f"{same[0].topic} of {len(same)} runs is taken; [log] may name another"
    return replace(report, topics=(same[0],)), (note,)


def _model_in(folder: Path, text: str) -> Model:
    """Writes model.py and loads it."""
    write_atomically(folder / "model.py", text.encode())
    return model_in(load_module(folder, "model.py"))


def _only_named(guess: Guess, of: str) -> Guess:
    """A guess of the generic skeleton: the log's own name, and nothing that says what it is."""
    why = f"named as in the log; that it is a{'n' * (of == 'input')} {of} is a guess"
    return replace(guess, sure=False, reasons=(*guess.reasons, why)) if guess.path else guess


def _left_out(report: LogReport, model: Model) -> tuple[str, ...]:
    """What a generic skeleton has no place for, and how to say what is an input."""
    left = [name for name in moving(report) if name not in {**model.states, **model.inputs}]
    found = [f"left out of model.py: {', '.join(reversed(left))}"] * bool(left)
    if not set(model.inputs) & set(moving(report)):
        last = next(iter(moving(report)), "A")
        found.append(f"no number looks like a command: --inputs says which are, --inputs {last}")
    return tuple(found)


def _in_seconds(report: LogReport) -> tuple[str, ...]:
    """What to do where a table's times are in another unit than seconds, and do not say so."""
    slow = [t for t in report.topics if t.topic == "/csv" and 0 < t.rate_hz < SLOWEST]
    return tuple(
        f"read in seconds, the rows come every {1 / t.rate_hz:.3g} s: are the times in ms or us? "
        "Then end that column's name with _ms or _us, and make the workspace anew"
        for t in slow
    )


def _asked(guess: Guess, ask: Ask, stated: Callable[..., Guess]) -> Guess:
    if guess.sure:
        return guess
    path = ask(guess)
    if path == guess.path:
        return replace(guess, sure=bool(path))
    why = ("as you said",)
    return stated(replace(guess, path=path, sure=bool(path), reasons=why, field=None, scale=1.0))


def _range(report: LogReport, guess: Guess) -> tuple[float, float] | None:
    """Lowest and highest value in the log, in the model's unit."""
    for topic in report.topics:
        for one in topic.fields:
            if one.path == guess.path and one.low is not None and one.high is not None:
                low, high = sorted((one.low * guess.scale, one.high * guess.scale))
                return low, high
    return None


def _recorded(
    folder: Path,
    files: Sequence[Path],
    model: Model,
    states: Sequence[Guess],
    dt: float,
    write: Callable[..., None],
) -> tuple[str, int, tuple[str, ...]]:
    """target.csv from the run in the log; where that can't be sampled, a target to be replaced."""
    here = Folder(folder)
    measured = [guess.name for guess in states if guess.path]
    mapping = log_mapping(here.config.log, model.state_names, model.input_names)
    try:
        if mapping is None or not measured:
            raise GroundedError("no signal of the log fits a state")
        found = read_log(files, mapping, dt, states=measured, angles=model.angles, steps=HORIZON)
    except GroundedError as error:
        write({model.state_names[0]: np.zeros(HORIZON + 1)}, HORIZON)
        return "zeros, to be replaced", HORIZON, (f"the run can't be sampled yet: {error}",)
    columns = dict(zip(measured, found.states.T, strict=True))
    horizon = len(found.states) - 1
    write(columns, horizon, dict(zip(mapping.inputs, found.inputs.T, strict=True)))
    return f"the run in the log, its first {horizon * dt:g} s", horizon, found.warnings
