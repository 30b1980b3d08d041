"""Detect columns that are not what their names say: other units, signs, places or clocks.

The next plan is based on the log, so the operator has to know before the next run. Each fault is
reported with its correction, in [log] or in the program that wrote the trial.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial
from grounded_trials.wording import ranges
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.read_before import paths_of, read_by

if TYPE_CHECKING:
    from grounded.instruments.predictions.mistaken import Mistake

# multiples of [safety]: an angle beyond TURNS as radians, but inside WIDER as degrees, is suspect
TURNS, WIDER = 5.0, 2.0
COVER = 0.9  # share of the largest command in a log that [limits] in its unit must reach


@dataclass(frozen=True)
class Fault:
    """A fault of a log and its correction.

    Args:
        said: the fault, in a clause or two.
        mend: what to change in [log], an imperative; "" if `said` includes it.
        program: what the program that writes trials should do instead; "" if `said` includes it.
        robot: why the robot is at fault and not the log, and what to undo on it: sentences.
        inputs: the inputs that are in another unit.
        factor: how many times too large these are, below 1 too small.
    """

    said: str
    mend: str = ""
    program: str = ""
    inputs: tuple[str, ...] = ()
    factor: float = 1.0
    robot: str = ""

    def told(self, trial: Trial, *, own: bool) -> str:
        """Return the warning; `own` is for a trial that was written by grounded, not a log."""
        if self.robot:
            again = f", `discard {trial.id}`" * bool(trial.id)
            again += f" and {f'run {trial.candidate}' if trial.candidate else 'record it'} again"
            return f"{self.said}. {self.robot}{again}"
        if own:
            should = f": it should {self.program}" * bool(self.program)
            again = f", `discard {trial.id}`" * bool(trial.id)
            again += f" and run {trial.candidate} again" * bool(trial.candidate)
            return f"{self.said}. Fix the program that writes the trials{should}{again}"
        if not self.mend:
            return self.said
        again = f"then discard {trial.id} and ingest the log again" if trial.id else ""
        return f"{self.said}. {self.mend}, {again or 'and ingest it again'}"


def log_faults(workspace: Folder, trial: Trial) -> tuple[Fault, ...]:
    """Return all faults found in the columns of a trial.

    Args:
        workspace: the workspace with the model and [safety].
        trial: the trial, with gaps bridged.
    """
    model, known = workspace.base_model, trial.until(trial.known_steps)
    if exchanged := _by_model(workspace, known):
        return exchanged  # other faults may only be a consequence
    found = [*_exchanged(workspace, known), *dead_sensors(model, trial), *_thousands(model, known)]
    found += [*way_faults(model, known), *positions_faults(model, known)]
    said = {fault.said for fault in found}
    degrees = [one for one in _degrees(model, known) if one.said not in said]
    found += degrees or _beyond_safety(workspace.task, trial)
    found += _clocks_apart(workspace, trial)
    found += mistaken_in(workspace, known)
    return tuple(_with_limits(workspace.task, known, one) for one in found)


def _with_limits(task: Task, known: Trial, fault: Fault) -> Fault:
    """Add the values to write for [limits] that are in the same wrong unit as a log's inputs.

    [limits] in the wrong unit reach as far as the wrong log. If the inputs are too small, they do
    not reach as far as the corrected log.
    """
    right = []
    for name in fault.inputs:
        j = known.input_names.index(name)
        ends, sent = (task.low[j], task.high[j]), np.abs(known.inputs[:, j]).max(initial=0.0)
        most, needed = max(map(abs, ends)), COVER * sent / min(fault.factor, 1.0)
        if np.isfinite(most) and (most >= needed) == (fault.factor > 1):
            low, high = (f"{end / fault.factor:.4g}" for end in ends)
            right.append(f"{name} = [{low}, {high}]")
    if not right:
        return fault
    unit = "reach as far as the log" if fault.factor > 1 else "do not reach as far as that log"
    return replace(fault, mend=f"{fault.mend}; [limits] {unit}: write {', '.join(right)} there")


def _exchanged(workspace: Folder, known: Trial) -> Iterator[Fault]:
    from grounded.instruments.kinematics.swapped import MIRRORED, exchanged, swapped_columns
    from grounded.instruments.predictions.mistaken import Mistake
    from grounded.places import integrals

    model, mapping = workspace.base_model, workspace.log_mapping
    if pair := swapped_columns(model, known, relations=integrals(model)):
        names = pair.removesuffix(MIRRORED).split(" and ")
        one, *more = (k for k, n in enumerate(model.state_names) if n in names)
        fault = Mistake(states=((one, more[0]),)) if more else None  # else one is an input
        robot = _on_the_robot(workspace, known, fault) if fault else ""
        mend = "Exchange their paths in [log]"
        if pair.endswith(MIRRORED) and mapping:
            odd = [n for n in names if n in mapping.states and mapping.states[n].scale < 0]
            mend += f", and make the scale in [log.state.{odd[0]}] positive" if odd else ""
        yield Fault(exchanged(pair), "" if robot else mend, robot=robot)


def _by_model(workspace: Folder, known: Trial) -> tuple[Fault, ...]:
    """Return a fault for two exchanged states that only the model reveals."""
    from grounded.instruments.kinematics.swapped import swapped_columns
    from grounded.instruments.predictions.exchanged_states import exchanged_states
    from grounded.instruments.predictions.mistaken import SWAP_BACK, described

    model = workspace.base_model
    if swapped_columns(model, known):
        return ()
    if (told := exchanged_states(model, known, range(model.n))) is None:
        return ()
    robot = _on_the_robot(workspace, known, told.mistake)
    said = described(model, told, robot=bool(robot))
    return (Fault(said, "" if robot else SWAP_BACK, robot=robot),)


def _on_the_robot(workspace: Folder, trial: Trial, fault: Mistake) -> str:
    """Return why an exchange is not the log's, and what to undo on the robot; "" if it may be.

    It is not if other trials that [log] read in the same way show none, or if the commands are
    those of the candidate only as they are logged: the program then had the same columns.
    """
    parts = ("wires", "sends or logs") if fault.inputs else ("sensors", "reads or logs")
    where = "the robot's {}, or what its program {},".format(*parts)
    if right := without(workspace, trial, fault):
        show = "shows" if len(right) == 1 else "show"
        return f"{ranges(right)}, read in the same way, {show} no exchange. Swap {where} back"
    if not _as_sent(workspace, trial, fault):
        return ""
    return (
        f"As logged, its commands are those of {trial.candidate}, so [log] is right. Swap {where} "
        "back, or exchange them in the model if the robot is as it should be"
    )


def without(workspace: Folder, trial: Trial, fault: Mistake) -> list[str]:
    """Return the other trials that were read in the same way and contradict an exchange."""
    from grounded.instruments.predictions.mistaken import contradicted
    from grounded_trials.workspace.last_diagnosis import diagnosable

    model, mapping = workspace.base_model, workspace.log_mapping
    names = [model.input_names[j] for j in fault.inputs]
    names += [model.state_names[i] for pair in fault.states for i in pair]
    metas = {one.stored.id: one.meta for one in workspace.whole_trials()}
    metas |= {one.stored.id: one.meta for one in workspace.aside_trials()}
    now = read_by(mapping) if mapping else {}
    read = {name: paths_of(meta, names) for name, meta in metas.items()}
    own = read.get(trial.id, paths_of(now, names))
    return [
        one.id
        for one in diagnosable(workspace)
        if one.id != trial.id
        and read.get(one.id) == own
        and contradicted(model, one, range(model.n), fault)
    ]


def _as_sent(workspace: Folder, trial: Trial, fault: Mistake) -> bool:
    """Return whether a run's commands are its candidate's, and would not be without an exchange."""
    from grounded.search.returned.who_drove import follows, latest

    if trial.candidate not in workspace.candidate_ids():
        return False
    policy, late = workspace.candidate(trial.candidate)[0].policy, latest(workspace.task)
    run = trial.until(policy.horizon)
    logged, mended = (follows(policy, one, late) for one in (run, fault.mended(run)))
    return logged is not None and logged.alike and not (mended is not None and mended.alike)


def dead_sensors(model: Model, trial: Trial) -> list[Fault]:
    """Return faults for velocities that do not follow the motion of their positions."""
    from grounded.instruments.kinematics.velocities import dead_rates

    return [
        Fault(
            f"{model.state_names[one.relation.j]} {one.told(model)}: is its sensor on?",
            "If it is, look for its column in [log]",
        )
        for one in dead_rates(model, trial)
    ]


def _thousands(model: Model, known: Trial) -> list[Fault]:
    """Return faults for positions or velocities that are too large by powers of a thousand."""
    from grounded.instruments.units.other_units import MEND, units_apart

    with np.errstate(all="ignore"):
        apart = units_apart(model, known, range(model.n)) if known.steps > 1 else []
    return [Fault(one, MEND) for one in apart]


def way_faults(model: Model, known: Trial) -> list[Fault]:
    """Return faults of heading and speeds found from the path: other axes, a compass, knots."""
    from grounded.accounts.finding import UnusableTrials
    from grounded.accounts.kinematics import kinematic_rows, tied
    from grounded.instruments.kinematics.way import judge_way

    rows = tied(kinematic_rows(model, range(model.n)))
    try:
        with np.errstate(all="ignore"):
            odd = list(judge_way(model, [replace(known, id="")], rows))
    except UnusableTrials as error:
        return [Fault(error.clauses, error.mend)]
    return [
        Fault(f"{one.signal} {one.finding}", f"Set {one.log} in [log.state.{one.signal}]")
        for one in odd
    ]


def positions_faults(model: Model, known: Trial) -> list[Fault]:
    """Return a fault for positions that move a power of ten as far as the commands say."""
    from grounded.instruments.units.plane_units import positions_off

    off = positions_off(model, known, range(model.n))
    return [Fault(off.described, off.mend, "write positions in the model's unit")] if off else []


def _degrees(model: Model, known: Trial) -> list[Fault]:
    """Return faults for angles in degrees that a diagnosis would correct, or refuse."""
    from grounded.accounts.finding import DEGREES
    from grounded.accounts.kinematics import kinematic_rows
    from grounded.instruments.preflight import preflight
    from grounded.instruments.units.mismatch import folded

    if lost := folded(model, [known], kinematic_rows(model, range(model.n))):
        names = [model.state_names[one.state] for one in lost]
        return [
            Fault(
                f"{name} {one.told(model)}",
                f"Multiply the scale in [log.state.{name}] by {1 / DEGREES:.8g} (a missing scale "
                "is 1)",
                f"write {model.states[name]}",
            )
            for name, one in zip(names, lost, strict=True)
        ]
    try:
        findings = preflight(model, [replace(known, id="")]).findings
    except GroundedError:  # the diagnosis reports it
        return []
    units = {**model.states, **model.inputs}
    return [
        Fault(
            f"{one.signal} {one.finding}",
            f"Multiply the scale in [log.{'state' if one.signal in model.states else 'input'}."
            f"{one.signal}] by {one.log.split(' = ')[1]} (a "
            "missing scale is 1)",
            f"write {units[one.signal]}",
            (one.signal,) if one.signal in model.inputs else (),
            one.scale,
        )
        for one in findings
        if one.kind == "degrees" and one.log
    ]


def _beyond_safety(task: Task, trial: Trial) -> list[Fault]:
    """Return faults for angles far beyond [safety] that would be inside if they were degrees."""
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
                    f"{name} goes to {most:.3g} rad, but [safety] is [{low:g}, {high:g}]: is it in "
                    f"degrees? Then it would be {np.deg2rad(most):.3g} rad",
                    f"Set scale = {np.pi / 180:.8g} in [log.state.{name}] if so",
                    "write rad",
                )
            )
    return found


def _clocks_apart(workspace: Folder, trial: Trial) -> list[Fault]:
    """Return a fault if measured states respond to commands before they are sent."""
    from grounded.accounts.commands import answers_early, one_clock, too_soon

    model, table = workspace.base_model, workspace.config.estimate
    measured: Collection[str] = model.state_names
    if table.names():
        from grounded_trials.workspace.intake.opening.estimating import read_estimate

        measured = read_estimate(table, model).measured
    shown = [i for i, name in enumerate(model.state_names) if name in measured]
    if (early := answers_early(model, trial, shown)) is None:
        return []
    mend = one_clock(model, shown, early)
    return [Fault(too_soon(model, early), mend, "stamp both by one clock")]


def mistaken_in(workspace: Folder, known: Trial) -> list[Fault]:
    """Return a fault if the model explains the log better with exchanged columns or other units."""
    from grounded.instruments.predictions.mistaken import as_logged, described, mended_by, mistaken
    from grounded.instruments.preflight import preflight

    model = workspace.base_model
    told = mistaken(model, [known], range(model.n))
    if told is not None:
        try:
            looked = preflight(model, [known])
        except GroundedError:  # another instrument fault: it may look like a sign error
            told = None if told.mistake.turned else told
        else:
            told = mistaken(model, looked.trials, range(model.n))
            told = told and as_logged(model, told, looked.findings)
    if told is None:
        return []
    swap = told.mistake.swap and not told.mistake.turned
    if swap and (robot := _on_the_robot(workspace, known, told.mistake)):
        return [Fault(described(model, told, robot=True), robot=robot)]
    scaled = () if told.mistake.swap else told.mistake.inputs
    names = tuple(model.input_names[j] for j in scaled)
    should = "write inputs in the model's unit" * bool(names)
    factor = told.mistake.factor
    return [Fault(described(model, told), mended_by(model, told), should, names, factor)]
