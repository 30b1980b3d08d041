"""Options that several commands share: --json, --details, --anyway, --trials, tables, jobs."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar

import click

from grounded.findings import found
from grounded.refusals import wrong
from grounded_cli.console import completion as complete
from grounded_cli.console.terminal import names_in

F = TypeVar("F", bound=Callable[..., Any])


def as_json(function: F) -> F:
    """Add the option --json, passed as `json_`."""
    return click.option("--json", "json_", is_flag=True, help="Print one JSON document.")(function)


def details(function: F) -> F:
    """Add the option --details: tell every finding."""
    return click.option("--details", is_flag=True, help="Tell all notes, with codes.")(function)


def anyway(function: F) -> F:
    """Add the option --anyway, for commands that hand a candidate over."""
    text = "Hand the candidate over even if [limits], [safety], task or model changed since."
    return click.option("--anyway", is_flag=True, help=text)(function)


def parallel(function: Callable[..., Any], by_itself: bool = False) -> Callable[..., Any]:
    """Add the options of a command that can run in parallel, passed as `engine`.

    by_itself: it runs on all idle processors unless --jobs says otherwise.
    """

    @functools.wraps(function)
    def call(*args: Any, jobs: int | None, engine: str, address: str | None, **others: Any) -> Any:
        from grounded.engine import Engine, idle

        jobs = jobs or (idle() if by_itself and engine == "local" else 1)
        return function(*args, engine=Engine(jobs=jobs, name=engine, address=address), **others)

    default = "all idle" if by_itself else "1"

    for option in (
        click.option("--address", metavar="URL", help="Scheduler of a Dask cluster."),
        click.option(
            "--engine",
            type=click.Choice(["local", "dask"]),
            default="local",
            help="Here (default), or a Dask cluster that sees this disk.",
        ),
        click.option(
            "--jobs",
            type=click.IntRange(1),
            metavar="N",
            help=f"Workers on this machine (default: {default}).",
        ),
    ):
        call = option(call)
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

    @functools.wraps(function)
    def call(*args: Any, columns: str | None, rate: float | None, **others: Any) -> Any:
        from grounded_trials.formats.tables import Layout

        return function(*args, layout=Layout(tuple(names_in(columns)), rate or 0.0), **others)

    for option in (
        click.option(
            "--rate",
            type=click.FloatRange(min=0, min_open=True),
            metavar="HZ",
            help="Rows a second of a table without times.",
        ),
        click.option("--columns", metavar="A,B,...", help="Columns of a table without names."),
    ):
        call = option(call)
    return call


def chosen_trials(function: F) -> F:
    """Add the option --trials, passed as a tuple of names; empty if it was not given."""
    return click.option(
        "--trials",
        metavar="T1,T2,...",
        shell_complete=complete.trials,
        callback=_trial_names,
        help="Only these trials (default: all).",
    )(function)


def _trial_names(ctx: click.Context, option: click.Parameter, text: str | None) -> tuple[str, ...]:
    chosen = tuple(names_in(text))
    if text is not None and not chosen:
        raise wrong("--trials", got=text, like="t0001,t0002")
    return chosen
