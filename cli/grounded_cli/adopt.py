"""grounded adopt: diagnosed effects join the model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import click

from grounded_cli import completion as complete
from grounded_cli.options import as_json, in_workspace, next_line, open_workspace
from grounded_cli.terminal import field, number, remark, sentence, show, show_json
from grounded_trials.wording import with_unit

if TYPE_CHECKING:
    from grounded_trials import Workspace

UNCLAIMED = (
    "was not claimed by the last diagnosis: its values were fitted by themselves, in place of what "
    "was claimed; the model's own parameters stay as they are"
)
BESIDE = (
    "was adopted from the same diagnosis, and stays in the model: its values were fitted in place "
    "of these, not beside them. Take it out of [model] effects in grounded.toml, or diagnose again"
)

BIASED = (
    "the robot is steered by what the sensor of {state} reads, {by}: where [task] start or the "
    "target was not measured by it, they are off by that. Add it there, or take it out of what is "
    "read, [log.state.{state}] offset = {off:.3g}, and in the robot's program"
)
SCALED = (
    "the target and [task] start, and how far off the target {state} is said to be, are of {state} "
    "as its sensor reads it, {by:.3g} % {more} than it is: for the true one scale what is read, "
    "[log.state.{state}] scale, and in the robot's program"
)
DRAW = (
    "draw the manoeuvre first (`grounded target --help`), or propose all the same to have that "
    "drive repeated"
)
REMEASURE = "nothing has measured the model as it is now yet: `grounded diagnose` does"


@click.command("adopt")
@click.argument("effects", nargs=-1, metavar="EFFECT...", shell_complete=complete.effects)
@click.option("--effect-only", is_flag=True, help="Leave the model's own parameters alone.")
@click.option("--undo", is_flag=True, help="Take the last adoption back.")
@in_workspace
@as_json
def command(effects: tuple[str, ...], effect_only: bool, undo: bool, json_: bool) -> None:
    """Add effects of the last diagnosis (`family:target`) to [model] in grounded.toml.

    Effects that were claimed together were estimated together: adopt them together. Parameters of
    the model that were calibrated beside them come along, in [model] params. An effect that was
    not claimed can be adopted by itself: its values come without parameters.

    The search goes on from the best policy, planned with the better model. --undo gives [model]
    the effects and parameters that it had before the last adoption; again, before the one before.
    """
    if undo == bool(effects) or (undo and effect_only):
        raise click.UsageError("name what to adopt, EFFECT..., or else --undo alone")
    workspace = open_workspace()
    if undo:
        _undo(workspace, json_)
        return
    before = workspace.base_model.params
    done = workspace.adopt(*effects, parameters=not effect_only)
    if json_:
        show_json(done.to_json())
        return
    for name in dict.fromkeys(effects):
        sentence(f"{name} is part of the model now ({workspace.config.file})")
    units = workspace.base_model.states
    for effect in done.effects:
        family, _, state = str(effect["name"]).partition(":")
        if family == "sensor_bias" and effect["name"] in effects:
            high = with_unit(f"{abs(effect['b']):.3g}", units[state])
            low = "low" if effect["b"] < 0 else "high"
            remark("note", BIASED.format(state=state, by=f"{high} too {low}", off=-effect["b"]))
        if family == "sensor_scale" and effect["name"] in effects:
            more, by = "more" if effect["k"] > 0 else "less", 100 * abs(effect["k"])
            remark("note", SCALED.format(state=state, by=by, more=more))
    if not done.claimed:
        remark("note", f"{effects[0]} {UNCLAIMED}")
    if done.beside:
        remark("warning", f"{', '.join(done.beside)} {BESIDE}")
    if done.params:
        show("written to [model] params, calibrated beside the effects:")
    for name, value in done.params.items():
        text = with_unit(f"{number(before[name].value)} -> {number(value)}", before[name].unit)
        show(field(name, text, "  "))
    for one in done.left.values():
        kept, beside = (with_unit(number(value), one.unit) for value in (one.kept, one.value))
        text = f"{one.called} stays at {kept}: these trials do not tell it"
        remark("note", f"{text}. The effects were fitted beside {beside}")
    if done.stopped:
        remark("note", done.stopped)
    if done.left:
        remark("note", REMEASURE)
    if done.logged:
        remark("note", f"target.csv is still {done.logged}, the drive that was logged: {DRAW}")
    show(f"\n{next_line(done.then)}")


def _undo(workspace: Workspace, json_: bool) -> None:
    """Takes the last adoption back, and prints what the model has again."""
    before = workspace.base_model.params
    done = workspace.undo_adoption()
    if json_:
        show_json(done.to_json())
        return
    sentence(f"undone: {', '.join(done.undone)} ({workspace.config.file})")
    now = workspace.base_model.params
    for name, was in before.items():
        if was.value != now[name].value:
            text = with_unit(f"{number(was.value)} -> {number(now[name].value)}", was.unit)
            show(field(name, text, "  "))
    rest = ", ".join(str(effect["name"]) for effect in done.effects)
    sentence(f"still part of the model: {rest}" if rest else "no effect is adopted now")
    show(f"\n{next_line(done.then)}")
