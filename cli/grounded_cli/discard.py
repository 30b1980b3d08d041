"""grounded discard, restore: leave trials out of everything, or use them again."""

from __future__ import annotations

from collections.abc import Iterator

from grounded_cli.console.terminal import field, names_in, show
from grounded_cli.console.workspace import next_line, open_workspace
from grounded_trials.workspace.discarding import SetAside


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
