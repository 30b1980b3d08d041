"""What is said of an account: a clause with its evidence, and what to do about it."""

from __future__ import annotations

import numpy as np

from grounded.accounts.judge import Told
from grounded.accounts.kinematics import turned
from grounded.accounts.table import DEGREES, WORDS, Account
from grounded.model import Model
from grounded.result import listed, with_unit


def names_of(model: Model, columns: object) -> list[str]:
    """Return the names of some columns: states, then inputs."""
    every = (*model.state_names, *model.input_names)
    return [every[k] for k in columns]  # type: ignore[attr-defined]


def table(model: Model, k: int) -> str:
    """Return the table of [log] that a column is read by."""
    return f"[log.{'state' if k < model.n else 'input'}.{names_of(model, [k])[0]}]"


def is_folded(model: Model, i: int) -> str:
    """Return a clause on an angle in degrees that was unwrapped in radians, after its name."""
    unit = list(model.states.values())[i]
    return f"is in degrees, but was unwrapped as an angle in {unit}"


def clause(model: Model, told: Told, *, log: bool = True, robot: bool = False) -> str:
    """Return one clause: what is wrong, and the evidence.

    Args:
        model: with the names and units.
        told: the account.
        log: whether to name keys of [log] that correct it.
        robot: the fault is the robot's, and the log is right.
    """
    said, *others = (_said(model, told, one, robot=robot) for one in (told.account, *told.others))
    text = said + _evidence(model, told)
    text += "".join(f", or else {other}" for other in others)
    if log and told.account.kind in ("unit", "sign") and told.account.columns:
        by = f"{1 / told.account.factor:.6g}"
        text += "; " + ", ".join(f"{table(model, k)} scale = {by}" for k in told.account.columns)
    return text


def _said(model: Model, told: Told, account: Account, *, robot: bool = False) -> str:
    names = listed(names_of(model, account.columns))
    one = len(account.columns) == 1
    if account.kind == "exchange":
        odd = f", with the sign of {names} reversed," * bool(account.columns)
        pairs = [" and ".join(names_of(model, pair)) for pair in account.pairs]
        if robot and min(account.pairs[0]) >= model.n:
            a, b = names_of(model, account.pairs[0])
            return f"the robot did with {a} what was sent as {b}, and the reverse"
        if robot:
            return f"the robot's sensors or program seem to exchange {', '.join(pairs)}"
        return f"the columns of {', '.join(pairs)}{odd} look exchanged"
    if account.kind == "dead":
        return f"{names} {_dead(model, told)}"
    if account.kind == "axes":
        psi, *speeds = names_of(model, account.columns)
        return (
            f"{listed(speeds)} are in the axes of {listed(_plane(model))}, not in body axes, into "
            f"which the model rotates them by {psi}"
        )
    if account.kind == "pace":
        how = "in milliseconds" if account.factor < 1 else "taken for milliseconds"
        return f"the stamps of the log are in another unit ({how})"
    if account.kind == "sign":
        return f"{names} look{'s' * one} logged with the opposite sign"
    large = account.factor > 1
    size = account.factor if large else 1 / account.factor
    unit = WORDS.get(account.unit, account.unit)
    unit = f" (in {unit}?)" * bool(unit)
    return f"{names} look{'s' * one} {size:.4g} times too {'large' if large else 'small'}{unit}"


def _plane(model: Model) -> list[str]:
    plane = turned(model)
    return names_of(model, (plane.i, plane.j)) if plane else []


def _evidence(model: Model, told: Told) -> str:
    if told.account.kind == "dead":
        return ": its sensor is off, or it is another signal"
    if told.by_motion is None:
        return ": only without that do positions move as velocities and angles imply"
    i, logged, mended, seconds = told.by_motion
    name = model.state_names[i]
    error = with_unit(f"{mended:.2g} instead of {logged:.2g}", model.states[name])
    return (
        f": only with that undone does the model predict the robot's motion (misses {name} by "
        f"{error} {seconds:g} s ahead)"
    )


def _dead(model: Model, told: Told, where: str = "") -> str:
    assert told.moved is not None
    i, mean, moved = told.moved
    name = model.state_names[i]
    return (
        f"shows no motion, only noise around {mean:.4g}{where}, while {name} moves by "
        f"{moved:.3g} {model.states[name]}"
    )


def remedy(model: Model, told: Told, k: int, where: str) -> tuple[str, str]:
    """Return what is said of one column that was corrected, and the keys of its [log] table.

    Args:
        model: with the names and units.
        told: the account.
        k: the column.
        where: the trials, if not all.
    """
    account, (name,) = told.account, names_of(model, [k])
    unit = {**model.states, **model.inputs}[name]
    if account.kind == "dead":
        return _dead(model, told, where), ""
    angle = np.rad2deg(account.offset)
    if account.kind == "offset":
        return f"is {-angle:.0f} degrees off the course given by the positions{where}", ""
    if account.kind == "unit":
        other = WORDS.get(account.unit, account.unit)
        if account.unit == "deg" and unit.endswith("/s"):
            other = "degrees a second"
        what = f"is in {other}, not in {unit}" if other else f"is too small by {DEGREES:.4g}"
        return f"{what}{where}", f"scale = {1 / account.factor:.8g}"
    if account.fitted and unit == "rad":
        text = (
            f"turns in the opposite direction to the course given by the positions{where}: it is "
            f"{angle:.0f} degrees minus the logged value (a compass counts clockwise from north)"
        )
        return text, f"scale = -1, offset = {account.offset:.8g}"
    return f"has the wrong sign{where}: with the other one positions fit velocities", "scale = -1"


def mend(model: Model, told: Told) -> str:
    """Return the instruction that corrects the log."""
    account = told.account
    tables = listed(table(model, k) for k in account.columns)
    if account.kind == "exchange":
        return "Correct the paths in [log] (or the model, if the log is right)"
    if account.kind == "dead":
        name = names_of(model, account.columns)[0]
        return f"Check the path in {tables}, or delete that table and estimate {name} ([estimate])"
    if account.kind == "axes":
        psi, *speeds = names_of(model, account.columns)
        return (
            f"Rotate {listed(speeds)} by -{psi} into body axes, both in the log and in the robot's "
            "program, or write the model with speeds in world axes"
        )
    if account.kind == "pace":
        return f"Multiply the stamps by {account.factor:g}"
    if account.kind == "sign":
        return (
            f"Reverse the sign in {tables} (scale = -1 if it has none) and in the robot's program; "
            "or in the model, if the log is right"
        )
    also = ", and [limits] if they were taken from the log" * (account.columns[0] >= model.n)
    by = f"{1 / account.factor:.8g}"
    return f"Multiply the scale in {tables} by {by} (a missing scale is 1){also}"
