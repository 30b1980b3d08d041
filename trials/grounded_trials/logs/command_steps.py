"""Find when commands change in an uncut log: where its control steps begin, and what came before.

If commands changed in the middle of grid steps, each would be up to half a step early or late, so
the data start at a change. If they change at any time, as a driver's do, a step has their mean.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded_trials.formats.message_path import parse_path
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.samples import Samples

FEW_CHANGES = 5  # with so few changes, the beginning of the steps can't be found
IN_STEP = 0.8  # length of the mean unit vector of phases above which commands are periodic
IN_ROWS = 0.9  # share of changes that fit one phase, each within its row, to be periodic
COARSEST = 0.6  # of a step: with longer rows any phase would fit
TOUCH = 0.01  # of a step: tolerance of the phase
TRIED = 256  # changes whose phases are tried
MOVED = 0.05  # of a step: a start nearer to a change than this is not moved
HELD = 0.5  # share of repeated rows above which rows are not written at changes of commands


def phase_of(
    changes: Floats, dt: float, late: Floats | None = None, *, whole_rows: bool = True
) -> tuple[float, float] | None:
    """Return the phase within a step at which commands change, and by how much earlier it may be.

    The latest possible one, -dt / 2 to dt / 2 [s]; None if the changes have no common phase. If
    table rows and commands have different periods, each change is seen late by another part of a
    row; all changes together leave little uncertainty.

    Args:
        changes: (K,) times at which a change was seen, from the beginning of a step [s].
        dt: control step [s].
        late: (K,) largest delay with which each change may have been seen [s]; None: no delay.
        whole_rows: whether a change may be seen late by a whole row, as that of a program that
            sends when a row is written. Else changes at either of two rows are in no step.
    """
    if len(changes) <= FEW_CHANGES:
        return None
    if late is not None and 0 < np.median(late) <= COARSEST * dt:
        tried = changes[np.unique(np.linspace(0, len(changes) - 1, TRIED).astype(int))]
        after = (changes - tried[:, None] + TOUCH * dt) % dt  # (tried, K)
        fits = after < late + 2 * TOUCH * dt * whole_rows
        best = int(np.argmax(fits.sum(axis=1)))
        if fits[best].mean() >= IN_ROWS:
            room = (late - after[best])[fits[best]].min() + TOUCH * dt
            phase = (float(tried[best]) + dt / 2) % dt - dt / 2
            return phase, float(np.clip(room, 0.0, np.median(late)))
    turns = np.exp(2j * np.pi * changes / dt)
    if abs(turns.mean()) < IN_STEP:
        return None
    room = 0.0 if late is None else float(np.median(late))
    return float(np.angle(turns.mean())) / (2 * np.pi) * dt, room


def changes_of(t: Ints, values: Floats) -> tuple[Ints, Ints]:
    """Return when a command was seen to change (K,), and by how much that may be late (K,) [ns]."""
    rows, order = held_rows(t, values) > 0, np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    new = np.flatnonzero(np.diff(values) != 0)
    return t[1:][new], np.diff(t)[new] if rows else np.zeros(len(new), np.int64)


def held_rows(t: Ints, values: Floats) -> float:
    """Return the interval of rows that repeat a held value [s], by which a change may be late.

    0 if rows, with stamps t (N,) [ns], do not repeat values. A command that stays at its limits, or
    at zero before a run, repeats its value as well, however often it is sent. So most values must
    be repeated, those at the limits aside.
    """
    order = np.argsort(t, kind="stable")
    y = values[order]
    if len(t) <= 2 * FEW_CHANGES or np.mean(np.diff(y) == 0) < HELD:
        return 0.0
    begins = np.flatnonzero(np.diff(y, prepend=np.nan) != 0)
    lasts, here = np.diff(begins, append=len(y)), y[begins]
    inside = (here > y.min()) & (here < y.max())
    if inside.sum() >= FEW_CHANGES and np.mean(lasts[inside] > 1) < HELD:
        return 0.0
    return float(np.median(np.diff(t[order]))) * 1e-9


def rows_apart(inputs: Sequence[Samples], states: Sequence[Samples]) -> float:
    """Return the interval of rows that hold both measurements and commands [s].

    0 if commands have messages of their own, whose stamps say when they were sent.
    """
    measured = {parse_path(s.spec.path).topic for s in states}
    shared = [s for s in inputs if parse_path(s.spec.path).topic in measured]
    return max((held_rows(s.t, s.y) for s in shared), default=0.0)


def first_step(inputs: Sequence[Samples], start: int, dt: float) -> tuple[int, bool]:
    """Return by how much to move the start of data [ns], and whether commands change in steps."""
    at, late = (
        np.concatenate(x) for x in zip(*(changes_of(s.t, s.y) for s in inputs), strict=True)
    )
    found, first = np.unique(at, return_index=True)
    here = found >= start - round(dt * 0.5e9)
    later, late = found[here], late[first][here]
    known = phase_of((later - start) * 1e-9, dt, late * 1e-9, whole_rows=False)
    if known is None:
        return 0, len(later) <= FEW_CHANGES
    phase = known[0]
    return round((phase % dt) * 1e9) * (abs(phase) >= MOVED * dt), True


def in_motion(inputs: Sequence[Samples], start: int, rest: Floats) -> bool:
    """Check whether a table starts with commands that are not those of rest."""
    rows = any(held_rows(s.t, s.y) > 0 for s in inputs)
    return rows and any(s.before(start) != u for s, u in zip(inputs, rest, strict=True))
