"""grounded adopt: add diagnosed effects to the model, or undo it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded.result import listed
from grounded_cli.console import completion as complete
from grounded_cli.console.options import as_json
from grounded_cli.console.terminal import LABEL, field, number, remark, sentence, show, show_json
from grounded_cli.console.workspace_option import in_workspace, next_line, open_workspace
from grounded_trials.wording import ALONE, misread, moved, with_unit

if TYPE_CHECKING:
    from collections.abc import Sequence

    from grounded_trials import Workspace
    from grounded_trials.workspace.adopting import Rewritten

DIGITS = 4  # of a parameter, at least
UNCLAIMED = (
    "was not claimed by the last diagnosis: its values were fitted on their own, instead of what "
    "was claimed; the model's own parameters are unchanged"
)
BESIDE = (
    "was adopted from the same diagnosis and stays in the model, but its values were fitted "
    "instead of these, not together with them. Remove it from [model] effects in grounded.toml, or "
    "diagnose again"
)

BIASED = (
    "the robot is steered by its sensor of {state}, which reads {by}. Do one of two things. Keep "
    "the effect: then {do}. Or correct the readings ([log.state.{state}] offset {off:+.3g}, and "
    "the same in the robot's program), remove sensor_bias:{state} from [model] effects, `discard` "
    "the trials and ingest their logs again"
)
SCALED = (
    "the target, [task] start and the reported distance of {state} from the target are in readings "
    "of its sensor, which shows {by:.3g} % {more} than the true value. For true values correct "
    "[log.state.{state}] scale and the scale in the robot's program, remove sensor_scale:{state} "
    "from [model] effects, `discard` the trials and ingest their logs again"
)
OLD = (
    "the target and the reported distance of {states} from it are in readings that are {by:.3g} s "
    "old: when they are on the target, the robot itself is ahead of it by that time"
)
ALONG = (
    "came along: the sensors show it, and the plan allows for it then, as the robot's program gets "
    "{it} that late"
)
BUT_LOGGED = (
    ". If only the log is late, run `grounded adopt --undo`, set the delay_s that the diagnosis "
    "gave in [log], and adopt again"
)
DRAW = "draw the manoeuvre first (`grounded target --help`), or propose anyway to repeat that drive"
REMEASURE = (
    "the changed model was not compared with the trials yet: `grounded diagnose` does that; "
    "`grounded fit` fits the parameters beside the effects"
)


@click.command("adopt")
@click.argument("effects", nargs=-1, metavar="EFFECT...", shell_complete=complete.effects)
@click.option("--effect-only", is_flag=True, help="Leave the model's own parameters alone.")
@click.option("--undo", is_flag=True, help="Undo the last adoption.")
@in_workspace
@as_json
def command(effects: tuple[str, ...], effect_only: bool, undo: bool, json_: bool) -> None:
    """Add effects of the last diagnosis (`family:target`) to [model] in grounded.toml.

    Effects that were claimed together were estimated together: adopt them together. The model
    parameters calibrated with them are written to [model] params. An effect that was not claimed
    can be adopted alone: its values come without parameters.

    The search goes on from the best policy and plans with the better model. --undo restores the
    effects and parameters that [model] had before the last adoption; repeat it to go further back.
    """
    if undo == bool(effects) or (undo and effect_only):
        raise click.UsageError("name the effects to adopt, EFFECT..., or give --undo alone")
    workspace = open_workspace()
    if undo:
        _undo(workspace, json_)
        return
    from grounded_trials.workspace.user_files.task_file import limits_of_log

    before = workspace.base_model.params
    done = workspace.adopt(*effects, parameters=not effect_only)
    if json_:
        show_json(done.to_json())
        return
    for name in dict.fromkeys(effects):
        alone = ALONE * (name in done.jointly)
        sentence(f"{name} is part of the model now ({workspace.config.file}){alone}")
    units, late = workspace.base_model.states, dict[float, list[str]]()
    for effect in done.effects:
        family, _, state = str(effect["name"]).partition(":")
        if family == "sensor_bias" and effect["name"] in effects:
            b = effect["b"]
            by = misread(b, units[state])
            do = _as_read(workspace, state, with_unit(f"{b:.3g}", units[state]), b)
            remark("note", BIASED.format(state=state, by=by, off=-b, do=do))
        if family == "sensor_scale" and effect["name"] in effects:
            more, by = "more" if effect["k"] > 0 else "less", 100 * abs(effect["k"])
            remark("note", SCALED.format(state=state, by=by, more=more))
        if family == "sensor_delay" and effect["name"] in effects:
            late.setdefault(effect["d"], []).extend(state.split("+"))
    for name in done.along:  # not named by the user
        only = BUT_LOGGED * name.startswith("sensor_delay:")
        remark("note", f"{name} {ALONG.format(it=name.partition(':')[2])}{only}")
    for age, states in late.items():
        remark("note", OLD.format(states=listed(states), by=age))
    if not done.claimed:
        remark("note", f"{effects[0]} {UNCLAIMED}")
    if done.beside:
        remark("warning", f"{', '.join(done.beside)} {BESIDE}")
    if done.params:
        show("written to [model] params, calibrated beside the effects:")
    for name, value in done.params.items():
        text = moved(before[name].value, value, before[name].unit, DIGITS)
        text += ALONE * (name in done.jointly)
        show(field(name, text, "  "))
    if done.rewritten:
        show("rewritten in [model] effects, fitted again beside the others:")
        _rewritten(done.rewritten)
    for one in done.left.values():
        kept, beside = (with_unit(number(value), one.unit) for value in (one.kept, one.value))
        text = f"{one.called} stays at {kept}: these trials do not determine it"
        remark("note", f"{text}. The effects were fitted with it at {beside}")
    if done.stopped:
        remark("note", done.stopped)
    if done.left:
        remark("note", REMEASURE)
    if bound := limits_of_log(workspace.config):
        remark("note", bound)
    if done.logged:
        remark("note", f"target.csv is still the logged drive, {done.logged}: {DRAW}")
    show(f"\n{next_line(done.then)}")


def _as_read(workspace: Workspace, state: str, bias: str, value: float) -> str:
    """Return what to do about values of a state that are given as true ones, not as readings.

    Args:
        workspace: the workspace.
        state: the state whose sensor has a bias.
        bias: that bias, with its unit.
        value: that bias.
    """
    from grounded_trials.workspace.candidates.standstill import read_at_start

    task = workspace.config.task
    file = workspace.folder / str(task.target)
    drawn = bool(task.target) and file.is_file() and state in workspace.read_target(file)[0]
    there = ["in the target"] * drawn
    if seen := read_at_start(workspace, state, value):
        kept = f"leave [task] start, which is what this sensor read at a standstill in {seen}"
        if not there:
            return f"{kept}; the target names no {state}"
        kept = f"{kept}, and "
    else:
        there, kept = ["in [task] start"] * (state in task.start) + there, ""
    if not there:
        return (
            f"{state} begins where its sensor reads 0, as neither [task] start nor the target "
            f"names it: if it truly begins at 0, write {state} = {value:.3g} in [task] start"
        )
    return f"{kept}add {bias} to {state} {listed(there)}, unless this sensor measured it"


def _rewritten(changes: Sequence[Rewritten]) -> None:
    """List quantities of effects that stay in the model, with their old and new values."""
    width = max(LABEL, *(len(one.called) for one in changes))
    for new in changes:
        show(field(new.called, moved(new.was, new.now, new.unit, DIGITS), "  ", width))


def _undo(workspace: Workspace, json_: bool) -> None:
    """Undo the last adoption and print the restored effects and parameters."""
    before = workspace.base_model.params
    done = workspace.undo_adoption()
    if json_:
        show_json(done.to_json())
        return
    sentence(f"undone: {', '.join(done.undone)} ({workspace.config.file})")
    now = workspace.base_model.params
    for name, was in before.items():
        if was.value != now[name].value:
            show(field(name, moved(was.value, now[name].value, was.unit, DIGITS), "  "))
    if done.rewritten:
        show("back in [model] effects:")
        _rewritten(done.rewritten)
    rest = ", ".join(str(effect["name"]) for effect in done.effects)
    sentence(f"still part of the model: {rest}" if rest else "no effect is adopted now")
    show(f"\n{next_line(done.then)}")
