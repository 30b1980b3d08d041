"""Columns that are not what the model calls by their names: other units, signs, places, clocks.

A plan is made of what such a log says, so whoever runs the robot has to know before the next run.
Each fault is told with what mends it: in [log], or in the program that wrote the trial.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from grounded.errors import GroundedError
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.logs.log_table import LogMapping
from grounded_trials.workspace.config import FILE
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.estimating import read_estimate

PART = re.compile(r"((?:^|[._])(?:orientation|rotation|quaternion))\.([xyzw])$")
ABOUT = {"x": "roll", "y": "pitch", "z": "yaw", "w": "yaw"}  # the angle that a part says most of
SMALL = 2.0  # times sin(a / 2): a small angle, which somebody who writes that knows
TURNS, WIDER = 5.0, 2.0  # of [safety]: beyond it in radians, about inside it in degrees


@dataclass(frozen=True)
class Fault:
    """What is wrong with a log, and what mends it.

    Args:
        said: a clause or two.
        mend: what to change in [log], an imperative; "" where `said` has it.
        program: what the program that writes trials should do instead; "": what `said` says.
        inputs: those that are in another unit.
    """

    said: str
    mend: str = ""
    program: str = ""
    inputs: tuple[str, ...] = ()

    def told(self, trial: Trial, *, own: bool) -> str:
        """The warning, of a trial that `own` writes in the model's units, or of a log."""
        if own:
            should = f": it should {self.program}" * bool(self.program)
            again = f", `discard {trial.id}`" * bool(trial.id)
            again += f" and run {trial.candidate} again" * bool(trial.candidate)
            return f"{self.said}. Mend the program that writes the trials{should}{again}"
        if not self.mend:
            return self.said
        return f"{self.said}. {self.mend}, and ingest it again" + f", without {trial.id}" * bool(
            trial.id
        )


def log_faults(workspace: Folder, trial: Trial) -> tuple[Fault, ...]:
    """All that is wrong with the columns of a trial without gaps.

    Args:
        workspace: whose model names them, and whose [safety] says what is too much.
        trial: as it is stored, or is to be.
    """
    model, known = workspace.base_model, trial.until(trial.known_steps)
    found = [*_exchanged(model, known), *dead_sensors(model, trial), *_thousands(model, known)]
    found += way_faults(model, known)
    said = {fault.said for fault in found}
    degrees = [one for one in _degrees(model, known) if one.said not in said]
    found += degrees or _beyond_safety(workspace.task, trial)
    found += _clocks_apart(workspace, trial)
    found += mistaken_in(model, known)
    return tuple(found)


def _exchanged(model: Model, known: Trial) -> Iterator[Fault]:
    from grounded.instruments.kinematics import integrals
    from grounded.instruments.swapped import exchanged, swapped_columns

    if pair := swapped_columns(model, known, relations=integrals(model)):
        yield Fault(exchanged(pair), "Exchange their paths in [log]")


def dead_sensors(model: Model, trial: Trial) -> list[Fault]:
    """Velocities that show nothing of what their positions do."""
    from grounded.instruments.dead import dead_rates

    return [
        Fault(
            f"{model.state_names[one.relation.j]} {one.told(model)}: is its sensor on?",
            "If it is, look for its column in [log]",
        )
        for one in dead_rates(model, trial)
    ]


def _thousands(model: Model, known: Trial) -> list[Fault]:
    """That a position, or its velocity, is in mm, or a thousand times too large twice over."""
    from grounded.instruments.other_units import MEND, units_apart

    with np.errstate(all="ignore"):
        apart = units_apart(model, known, range(model.n)) if known.steps > 1 else []
    return [Fault(one, MEND) for one in apart]


def way_faults(model: Model, known: Trial) -> list[Fault]:
    """What the way that was travelled says of heading and speeds: other axes, a compass, knots."""
    from grounded.instruments.rows import kinematic_rows, tied
    from grounded.instruments.way import judge_way

    rows = tied(kinematic_rows(model, range(model.n)))
    try:
        with np.errstate(all="ignore"):
            odd = list(judge_way(model, [replace(known, id="")], rows))
    except GroundedError as error:
        return [Fault(str(error).replace("in trial number 1 ", ""))]
    return [
        Fault(f"{one.signal} {one.finding}", f"Set {one.log} in [log.state.{one.signal}]")
        for one in odd
    ]


def _degrees(model: Model, known: Trial) -> list[Fault]:
    """Degrees that a diagnosis would put right."""
    from grounded.instruments.preflight import preflight

    try:
        findings = preflight(model, [replace(known, id="")]).findings
    except GroundedError:  # it stops the diagnosis, which tells it
        return []
    return [
        Fault(
            f"{one.signal} {one.finding}",
            f"Multiply the scale in [log.state.{one.signal}] by {one.log.split(' = ')[1]} (1 "
            "where none is given)",
            f"write {model.states[one.signal]}",
        )
        for one in findings
        if one.kind == "degrees" and one.log
    ]


def _beyond_safety(task: Task, trial: Trial) -> list[Fault]:
    """Angles far beyond [safety] that would be inside, were they degrees."""
    assert task.safety_low is not None and task.safety_high is not None
    found = []
    for i, (name, unit) in enumerate(task.model.states.items()):
        x, low, high = trial.states[:, i], task.safety_low[i], task.safety_high[i]
        most = float(np.abs(x[np.isfinite(x)]).max(initial=0.0))
        allowed = max(abs(low), abs(high))
        inside = np.deg2rad(most) <= WIDER * allowed
        if unit == "rad" and np.isfinite(allowed) and most > TURNS * allowed and inside:
            found.append(
                Fault(
                    f"{name} goes to {most:.3g} rad, [safety] is [{low:g}, {high:g}]: in degrees? "
                    f"It would be {np.deg2rad(most):.3g} rad then",
                    f"Set scale = {np.pi / 180:.8g} in [log.state.{name}] if so",
                    "write rad",
                )
            )
    return found


def _clocks_apart(workspace: Folder, trial: Trial) -> list[Fault]:
    """That measured states answer commands before they are sent."""
    from grounded.instruments.clocks import answers_early, one_clock, too_soon

    model, table = workspace.base_model, workspace.config.estimate
    measured = read_estimate(table, model).measured if table.names() else model.state_names
    shown = [i for i, name in enumerate(model.state_names) if name in measured]
    if (early := answers_early(model, trial, shown)) is None:
        return []
    mend = one_clock(model, shown, early)
    return [Fault(too_soon(model, early), mend, "stamp both by one clock")]


def mistaken_in(model: Model, known: Trial) -> list[Fault]:
    """What the model says of exchanged commands or other units."""
    from grounded.instruments.mistaken import as_logged, described, mended_by, mistaken
    from grounded.instruments.preflight import preflight

    told = mistaken(model, [known], range(model.n))
    if told is not None:
        try:
            looked = preflight(model, [known])
        except GroundedError:  # of other instruments: the diagnosis tells what looks turned so
            told = None if told.mistake.turned else told
        else:
            told = mistaken(model, looked.trials, range(model.n))
            told = told and as_logged(model, told, looked.findings)
    if told is None:
        return []
    scaled = () if told.mistake.swap else told.mistake.inputs
    names = tuple(model.input_names[j] for j in scaled)
    should = "write inputs in the model's unit" * bool(names)
    return [Fault(described(model, told), mended_by(model, told), should, names)]


def no_angles(model: Model, mapping: LogMapping | None) -> Mapping[str, str]:
    """States in rad or deg that are read from a part of a quaternion, and what to say of each.

    The z of an orientation is sin(yaw / 2): as smooth as a yaw, about half as large, and from a
    quarter turn on something else. No instrument tells it from a gain, but the path does.

    Args:
        model: whose states they are.
        mapping: which column each is read from; None: nothing is read.
    """
    found = {}
    for name, one in (mapping.states if mapping else {}).items():
        part = PART.search(one.path)
        angle = name in model.angles or model.states.get(name) in ("rad", "deg")
        if part and angle and abs(one.scale) != SMALL:
            instead = f"{one.path[: part.end(1)]}.@rpy.{ABOUT[part[2]]}"
            found[name] = (
                f"is read from {one.path}, a part of a quaternion, which is no angle: "
                f"{instead} is, in {FILE}'s [log.state.{name}]"
            )
    return found
