"""`command`, which makes a function a command, and the options that several commands share."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import click

from grounded.findings import found
from grounded.refusals import wrong
from grounded_cli.console import completion as complete
from grounded_cli.console.terminal import names_in, show_json, stdout_kept
from grounded_cli.console.workspace_option import in_workspace

F = TypeVar("F", bound=Callable[..., Any])
_CODE = "grounded_cli.code"


def command(
    name: str, *, workspace: bool = True, json: bool = True, **settings: Any
) -> Callable[[Callable[..., Iterator[Any]]], click.Command]:
    """Make a function a command, with the options -C and --json.

    The function yields its result, and then tells it to a person: with --json, the document of the
    result is printed instead. stdout is kept for either, whatever the user's code prints.

    Args:
        name: the command.
        workspace: whether it takes -C.
        json: whether it takes --json.
        **settings: those of `click.command`.
    """

    def made(function: Callable[..., Iterator[Any]]) -> click.Command:
        @functools.wraps(function)
        def call(*args: Any, json_: bool = False, **options: Any) -> int:
            with stdout_kept():
                telling = function(*args, **options)
                done = next(telling)
                if json_:
                    show_json(done if isinstance(done, dict) else done.to_json())
                else:
                    list(telling)
            code: int = click.get_current_context().meta.get(_CODE, 0)
            return code

        found = click.command(name, cls=click.Command, **settings)(call)
        if workspace:
            in_workspace(found)
        if json:
            text = "Print one JSON document."
            found.params.append(click.Option(["--json", "json_"], is_flag=True, help=text))
        return found

    return made


def exits(code: int) -> None:
    """Let the running command end with this exit code, once it has told its result."""
    click.get_current_context().meta[_CODE] = code


def json_asked() -> bool:
    """Return whether the running command was given --json."""
    return bool(click.get_current_context().params.get("json_"))


def flag(*names: str, help: str) -> Callable[[F], F]:
    """Add an option without a value."""
    return click.option(*names, is_flag=True, help=help)


details = flag("--details", help="Tell all notes, with codes.")
anyway = flag(
    "--anyway", help="Hand the candidate over even if [limits], [safety], task or model changed."
)


def parallel(function: Callable[..., Any], by_itself: bool = False) -> Callable[..., Any]:
    """Add the options of a command that can run in parallel, passed as `engine`.

    by_itself: it runs on all processors unless --jobs says otherwise.
    """
    default = "all processors" if by_itself else "1"
    workers = f"Workers on this machine (default: {default})."

    @click.option("--jobs", type=click.IntRange(1), metavar="N", help=workers)
    @functools.wraps(function)
    def call(*args: Any, jobs: int | None, **others: Any) -> Any:
        from grounded.engine import Engine, cores

        return function(*args, engine=Engine(jobs or (cores() if by_itself else 1)), **others)

    return call


def misuse(*options: str, how: str = "one") -> click.UsageError:
    """Return the error of options that don't go together: "one" of them, "first", "both"."""
    return click.UsageError(found("given.either", *options, how=how).sentence)


def values_by_name(pairs: tuple[str, ...], option: str) -> dict[str, float]:
    """Return the values of an option such as --to x=1.0, by name."""
    values = {}
    for pair in pairs:
        name, _, value = pair.partition("=")
        try:
            end = float(value)
        except ValueError:
            end = math.nan
        if not math.isfinite(end):
            raise click.UsageError(str(wrong(option, got=pair, like="x=1.0")))
        values[name.strip()] = end
    return values


def table_layout(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add --columns and --rate, passed as `layout`: what a table without names or times lacks."""
    above, rows = click.FloatRange(min=0, min_open=True), "Rows a second of a table without times."

    @click.option("--columns", metavar="A,B,...", help="Columns of a table without names.")
    @click.option("--rate", type=above, metavar="HZ", help=rows)
    @functools.wraps(function)
    def call(*args: Any, columns: str | None, rate: float | None, **others: Any) -> Any:
        from grounded_trials.formats.tables import Layout

        return function(*args, layout=Layout(tuple(names_in(columns)), rate or 0.0), **others)

    return call


def _trial_names(ctx: click.Context, option: click.Parameter, text: str | None) -> tuple[str, ...]:
    chosen = tuple(names_in(text))
    if text is not None and not chosen:
        raise wrong("--trials", got=text, like="t0001,t0002")
    return chosen


chosen_trials = click.option(
    "--trials",
    metavar="T1,T2,...",
    shell_complete=complete.trials,
    callback=_trial_names,
    help="Only these trials (default: all).",
)
which_candidate = click.option(
    "--candidate", metavar="ID", shell_complete=complete.candidates, help="Which candidate was run."
)
