"""grounded completion: shell completion of commands, candidates, trials, effects and examples.

`candidates`, `trials` and `effects` are for `shell_complete=` of arguments and options. To answer
fast they read file names (and the last diagnosis), never a trial or a model.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import click
from click.shell_completion import CompletionItem, get_completion_class

from grounded.errors import GroundedError
from grounded_cli.console.terminal import show
from grounded_cli.console.workspace_option import given

SHELLS = ("bash", "zsh", "fish")


@click.command("completion")
@click.argument("shell", type=click.Choice(SHELLS))
def completion(shell: str) -> None:
    """Print the script that makes the TAB key complete commands, candidates, trials and effects.

    \b
    bash:  echo 'eval "$(grounded completion bash)"' >> ~/.bashrc
    zsh:   echo 'eval "$(grounded completion zsh)"' >> ~/.zshrc
    fish:  grounded completion fish > ~/.config/fish/completions/grounded.fish
    """  # noqa: D301
    root = click.get_current_context().find_root().command
    maker = get_completion_class(shell)
    assert maker is not None
    script = maker(root, {}, "grounded", "_GROUNDED_COMPLETE").source()
    if shell == "bash":  # otherwise bash splits `dead_zone:throttle` into two words
        script += '\nCOMP_WORDBREAKS="${COMP_WORDBREAKS//:/}"\n'
    show(script)


def candidates(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete candidate names (c0001) and `best`."""
    files = (_folder(ctx) / "candidates").glob("c[0-9]*.mcap")
    return _items(["best", *sorted(path.stem for path in files)], incomplete)


def trials(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete trial names (t0001)."""
    files = (_folder(ctx) / "trials").glob("t[0-9]*-*.mcap")
    return _items(sorted(path.name.split("-")[0] for path in files), incomplete)


def effects(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the effects that the last diagnosis ranked, best first."""
    from grounded_trials.workspace.last_diagnosis import read_diagnosis

    try:
        found = read_diagnosis(_folder(ctx) / "reports")
    except GroundedError:
        return []
    return _items([ranked.effect for ranked in found.ranking] if found else [], incomplete)


def examples(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete the names of the examples."""
    from grounded_trials.starting.examples import EXAMPLES

    return [
        CompletionItem(name, help=example.text)
        for name, example in EXAMPLES.items()
        if name.startswith(incomplete)
    ]


def _items(names: Iterable[str], incomplete: str) -> list[CompletionItem]:
    return [CompletionItem(name) for name in names if name.startswith(incomplete)]


def _folder(ctx: click.Context) -> Path:
    """Return the workspace that -C names, at the command or before it."""
    return Path(given(ctx) or ".")
