"""The option --trials of `fit` and `diagnose`: use only these trials."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from grounded.errors import GroundedError
from grounded_cli import completion as complete
from grounded_cli.terminal import names_in

F = TypeVar("F", bound=Callable[..., Any])


def chosen_trials(function: F) -> F:
    """Add the option --trials, passed as a tuple of names; empty if it was not given."""
    return click.option(
        "--trials",
        metavar="T1,T2,...",
        shell_complete=complete.trials,
        callback=_names,
        help="Only these trials (default: all).",
    )(function)


def _names(ctx: click.Context, option: click.Parameter, text: str | None) -> tuple[str, ...]:
    chosen = tuple(names_in(text))
    if text is not None and not chosen:
        raise GroundedError(
            "--trials names no trial: expected some, like t0001,t0002; omit it to use all"
        )
    return chosen
