"""`command`, which declares a command, the options of several commands, and their values."""

from __future__ import annotations

import functools
import gc
import math
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any, TypeVar

import click

from grounded.findings import found
from grounded.refusals import wrong
from grounded_cli.console.terminal import located, names_in, show_json, stdout_kept

F = TypeVar("F", bound=Callable[..., Any])
_CODE = "grounded_cli.code"


def command(
    group: click.Group, name: str, module: str = "", *, workspace: bool = True, json: bool = True
) -> Callable[[Callable[[], None]], click.Command]:
    """Make a function's options and docstring a command, with the options -C and --json.

    What the command does is the function of the same name in a module of `grounded_cli`, which is
    imported when it is called. It gets the options, yields its result, and then tells it to a
    person: with --json, the document of the result is printed instead. stdout is kept for either,
    whatever the user's code prints.

    Args:
        group: where it belongs.
        name: the command.
        module: where its function is; "": in the module of the command's name.
        workspace: whether it takes -C.
        json: whether it takes --json.
    """

    def made(declared: Callable[[], None]) -> click.Command:
        def call(json_: bool = False, **options: Any) -> int:
            function: Callable[..., Iterator[Any]]
            function = getattr(import_module(f"grounded_cli.{module or name}"), declared.__name__)
            gc.enable()  # see `start`
            with stdout_kept():
                telling = function(**options)
                done = next(telling)
                if json_:
                    show_json(done if isinstance(done, dict) else done.to_json())
                else:
                    list(telling)
            code: int = click.get_current_context().meta.get(_CODE, 0)
            return code

        functools.update_wrapper(call, declared)  # its help and its parameters
        one = click.command(name, cls=click.Command)(call)
        if workspace:
            in_workspace(one)
        if json:
            text = "Print one JSON document."
            one.params.append(click.Option(["--json", "json_"], is_flag=True, help=text))
        group.add_command(one)
        return one

    return made


def in_workspace(command: click.Command) -> None:
    """Add the option -C DIR to the group or a command; `given` returns its value."""
    text = "The workspace (default: here)."
    option = click.Option(["-C"], metavar="DIR", expose_value=False, callback=located, help=text)
    command.params.append(option)


def flag(*names: str, help: str) -> Callable[[F], F]:
    """Add an option without a value."""
    return click.option(*names, is_flag=True, help=help)


def parallel(default: str) -> Callable[[F], F]:
    """Add --jobs to a command that can run in parallel."""
    text = f"Workers on this machine (default: {default})."
    return click.option("--jobs", type=click.IntRange(1), metavar="N", help=text)


def table_layout(declared: F) -> F:
    """Add --columns and --rate: what a table without names or times lacks."""
    above, rows = click.FloatRange(min=0, min_open=True), "Rows a second of a table without times."
    declared = click.option("--rate", type=above, metavar="HZ", help=rows)(declared)
    columns = "Columns of a table without names."
    return click.option("--columns", metavar="A,B,...", help=columns)(declared)


# for the modules of commands


def exits(code: int) -> None:
    """Let the running command end with this exit code, once it has told its result."""
    click.get_current_context().meta[_CODE] = code


def json_asked() -> bool:
    """Return whether the running command was given --json."""
    return bool(click.get_current_context().params.get("json_"))


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


def names_of(text: str | None, option: str, like: str) -> list[str]:
    """Return the names in an option such as --trials t0001,t0002; [] if it was not given."""
    names = names_in(text)
    if text is not None and not names:
        raise wrong(option, got=text, like=like)
    return names
