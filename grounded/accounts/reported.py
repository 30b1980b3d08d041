"""An account as a finding of the catalogue: its facts, its evidence, and the keys of [log]."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from grounded.accounts.table import WORDS, Account, Told
from grounded.findings import Finding, Quantity, found
from grounded.model import Model


def names_of(model: Model, columns: Iterable[int]) -> tuple[str, ...]:
    """Return the names of some columns: states, then inputs."""
    every = (*model.state_names, *model.input_names)
    return tuple(every[k] for k in columns)


def tables(model: Model, names: Iterable[str]) -> tuple[str, ...]:
    """Return the tables of [log] that some columns are read by."""
    return tuple(f"[log.{'state' if n in model.states else 'input'}.{n}]" for n in names)


def scaled(model: Model, names: Iterable[str], factor: float, unit: str = "") -> Finding:
    """Return that columns are too large by a factor, in this unit if it is known; -1: a sign."""
    names, units = tuple(names), {**model.states, **model.inputs}
    facts: dict[str, Any] = {"tables": tables(model, names), "by": 1 / factor}
    if factor == -1:
        return found("log.sign", *names, **facts)
    facts["own"] = tuple(dict.fromkeys(units[name] for name in names))
    if unit:
        turning = unit == "deg" and all(units[name].endswith("/s") for name in names)
        return found(
            "log.unit",
            *names,
            unit="degrees a second" if turning else WORDS.get(unit, unit),
            **facts,
        )
    size = abs(factor) if abs(factor) > 1 else 1 / abs(factor)
    large = "large" if abs(factor) > 1 else "small"
    negative = "the other sign" if factor < 0 else ""
    return found("log.unit", *names, times=size, size=large, negative=negative, **facts)


def reported(model: Model, told: Told, column: int | None = None) -> list[Finding]:
    """Return an account, of one of its columns if it is named, and those that explain as much."""
    first = _reported(model, told, told.account, column)
    evidence: dict[str, Any] = {}
    if told.by_motion:
        i, logged, mended, seconds = told.by_motion
        unit = model.states[model.state_names[i]]
        evidence = {"state": model.state_names[i], "ahead": seconds}
        evidence |= {"logged": Quantity(logged, unit), "mended": Quantity(mended, unit)}
    others = [_reported(model, told, one, None).also(tied=first.about) for one in told.others]
    return [first.also(**evidence), *others]


def _reported(model: Model, told: Told, account: Account, column: int | None) -> Finding:
    columns = account.columns if column is None else (column,)
    names, code = names_of(model, columns), f"log.{account.kind}"
    if account.kind == "exchange":
        pairs = names_of(model, (k for pair in account.pairs for k in pair))
        return found(code, *pairs, reversed=names)
    if account.kind == "dead" and told.moved:
        i, mean, moved = told.moved
        name = model.state_names[i]
        return found(code, *names, mean=mean, state=name, moved=Quantity(moved, model.states[name]))
    if account.kind == "offset":
        return found(code, *names, angle=-float(np.rad2deg(account.offset)))
    if account.kind == "axes":
        psi, *speeds = names
        return found(code, *speeds, heading=psi)
    if account.kind == "pace":
        return found(code, by=account.factor)
    if account.fitted and model.states.get(names[0]) == "rad":
        angle = float(np.rad2deg(account.offset))
        return found("log.compass", *names, angle=angle, tables=tables(model, names))
    return scaled(model, names, account.factor, account.unit)


def keys(model: Model, account: Account, column: int) -> dict[str, float]:
    """Return the keys of a column's table of [log] that correct it."""
    if account.kind == "unit":
        return {"scale": float(f"{1 / account.factor:.8g}")}
    if account.kind != "sign":
        return {}
    angle = {**model.states, **model.inputs}[names_of(model, [column])[0]] == "rad"
    offset = {"offset": account.offset} if account.fitted and angle else {}
    return {"scale": -1.0, **offset}
