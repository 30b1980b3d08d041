"""grounded adopt, discard, restore: what is added to the model, and which trials count."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from grounded_cli.console.options import misuse
from grounded_cli.console.terminal import (
    field,
    names_in,
    next_line,
    open_workspace,
    sentence,
    show,
    tell,
)
from grounded_trials.wording import ALONE, moved
from grounded_trials.workspace.adoption import Adopted, numbers_in
from grounded_trials.workspace.discarding import SetAside

DIGITS = 4  # of a parameter, at least


def adopt(effects: tuple[str, ...], effect_only: bool, undo: bool) -> Iterator[Adopted]:
    """Adopt effects, or undo the last adoption; print what changed."""
    if undo == bool(effects) or (undo and effect_only):
        raise misuse("EFFECT...", "--undo")
    workspace = open_workspace()
    before, file = workspace.base_model.params, workspace.config.file
    were = numbers_in(workspace)
    adopted = partial(workspace.adopt, *effects, parameters=not effect_only)
    done = workspace.undo_adoption() if undo else adopted()
    yield done
    if undo:
        sentence(f"undone: {', '.join(done.undone)} ({file})")
    for name in dict.fromkeys((*effects, *done.along)):
        show(field("adopted", f"{name}{ALONE * (name in done.jointly)}"))
    tell(done.findings)
    now = workspace.base_model.params
    values = [name for name, was in before.items() if was.value != now[name].value]
    if values:
        show("[model] params:")
    for name in values:
        text = moved(before[name].value, now[name].value, now[name].unit, DIGITS)
        show(field(name, text + ALONE * (name in done.jointly), "  "))
    known = numbers_in(workspace)
    if changed := {name: one for name, one in known.items() if were.get(name, one) != one}:
        show("[model] effects:")
    for name, (value, unit) in changed.items():
        show(field(name, moved(were[name][0], value, unit, DIGITS), "  "))
    if undo:
        show(field("adopted", ", ".join(str(one["name"]) for one in done.effects) or "none"))
    show(f"\n{next_line(done.then)}")


def discard(trials: tuple[str, ...], why: str) -> Iterator[SetAside]:
    """Set trials aside."""
    done = open_workspace().discard(*names_in(",".join(trials)), why=why)
    yield done
    _tell(done)


def restore(trials: tuple[str, ...]) -> Iterator[SetAside]:
    """Use trials again."""
    done = open_workspace().restore(*names_in(",".join(trials)))
    yield done
    _tell(done)


def _tell(done: SetAside) -> None:
    for name in done.trials:
        if name not in done.unchanged:
            show(f"{name} {'discarded' if name in done.discarded else 'counts again'}")
        else:
            show(f"{name}: nothing was changed")
    for name, why in done.discarded.items():
        show(field("discarded", f"{name}{why and ': ' + why}"))
    show(f"\n{next_line(done.then)}")
