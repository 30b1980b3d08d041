"""When commands change, in a log that nobody cut: where its steps begin, and what was held before.

Where commands change within the steps of the grid, all of them would lie up to half a step early or
late: data begin with the next change. A recording that begins in motion does not say what was
commanded before it; with a delay in the model its first steps would be judged by commands that
nobody knows. There data begin where the commands have been steady for a while. A robot that stands
still until its first command was sent nothing, or what holds it there.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from grounded_trials.formats.message_path import parse_path
from grounded_trials.formats.messages import Floats, Ints
from grounded_trials.logs.samples import Samples

FEW = 5  # changes, which are too few to say when the steps begin
IN_STEP = 0.8  # mean of the changes' phases, as unit vectors: the commands come in steps
IN_ROWS = 0.9  # of the changes can have been at one phase, each within its row: likewise
COARSEST = 0.6  # of a step: longer rows would allow any changes
TOUCH = 0.01  # of a step: how exactly commands come in steps
TRIED = 256  # changes whose phases are tried
MOVED = 0.05  # of a step; a start that is nearer to a change is left where it is
HELD = 0.5  # of a table's rows repeat the one before: it was not made where commands change
STEADY_S, STEADY_STEPS = 0.25, 4  # without a change, both: what was commanded before is known
LOOK_S, LOOK = 3.0, 0.2  # how far into a log, and into what share of it, such a moment is sought
STILL_S = 0.2  # of a standstill say that it is one
STILL, NOISE = 2e-3, 4.0  # of a state's range, and times its noise: what stands still is within


def phase_of(changes: Floats, dt: float, late: Floats | None = None) -> tuple[float, float] | None:
    """When within a step commands change, and by how much earlier that may be; None: not in steps.

    Rows that are not in step with the commands show each change late by another part of a row; all
    of them together leave little room.

    Args:
        changes: (K,) when one was seen to change, counted from the beginning of a step [s].
        dt: the step [s].
        late: (K,) by how much each may have been seen late [s]; None: by nothing.

    Returns:
        The latest such instant, -dt / 2 to dt / 2, and the room before it [s].
    """
    if len(changes) <= FEW:
        return None
    if late is not None and 0 < np.median(late) <= COARSEST * dt:
        tried = changes[np.unique(np.linspace(0, len(changes) - 1, TRIED).astype(int))]
        after = (changes - tried[:, None] + TOUCH * dt) % dt  # (tried, K)
        fits = after < late + 2 * TOUCH * dt
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
    """When a command was seen to change (K,), and by how much that may be late (K,) [ns].

    Args:
        t: (N,) stamps [ns].
        values: (N,) as for `held_rows`.
    """
    rows, order = held_rows(t, values) > 0, np.argsort(t, kind="stable")
    t, values = t[order], values[order]
    new = np.flatnonzero(np.diff(values) != 0)
    return t[1:][new], np.diff(t)[new] if rows else np.zeros(len(new), np.int64)


def held_rows(t: Ints, values: Floats) -> float:
    """By how much a held value is seen late [s]: the time between rows that repeat it; 0: by none.

    Args:
        t: (N,) stamps [ns].
        values: (N,) one that changes, each with its own stamp, or one that every row repeats.
    """
    order = np.argsort(t, kind="stable")
    if len(t) <= 2 * FEW or np.mean(np.diff(values[order]) == 0) < HELD:
        return 0.0
    return float(np.median(np.diff(t[order]))) * 1e-9


def rows_apart(inputs: Sequence[Samples], states: Sequence[Samples]) -> float:
    """The time between rows that say what is measured and, each anew, what is commanded [s].

    0 where commands have messages of their own: their stamps say when they were sent.
    """
    measured = {parse_path(s.spec.path).topic for s in states}
    shared = [s for s in inputs if parse_path(s.spec.path).topic in measured]
    return max((held_rows(s.t, s.y) for s in shared), default=0.0)


def first_step(inputs: Sequence[Samples], start: int, dt: float, unknown: bool) -> tuple[int, str]:
    """From a start to where data begin [ns], and a warning, "" for none.

    Args:
        inputs: the commands.
        start: where every signal is known [ns].
        dt: the step [s].
        unknown: whether nobody knows what was sent before, see `in_motion`.
    """
    at, late = (
        np.concatenate(x) for x in zip(*(changes_of(s.t, s.y) for s in inputs), strict=True)
    )
    found, first = np.unique(at, return_index=True)
    here = found >= start - round(dt * 0.5e9)
    later, late = found[here], late[first][here]
    known, moved, warning = phase_of((later - start) * 1e-9, dt, late * 1e-9), 0, ""
    phase = known and known[0]
    if phase is not None and abs(phase) >= MOVED * dt:
        moved = round((phase if phase > 0 else phase + dt) * 1e9)
    elif phase is None and len(later) > FEW:
        apart = float(np.median(np.diff(later))) * 1e-9
        if apart > dt / 2:  # oftener, and a step has the mean
            warning = (
                f"commands change every {apart:.3g} s, not in steps of {dt:g} s: each is up to "
                f"{dt / 2:.3g} s early or late, and so is a delay that is found"
            )
    if unknown:
        moved = _steady(inputs, found, start, moved, dt)
    return moved, warning


def in_motion(inputs: Sequence[Samples], start: int, rest: Floats) -> bool:
    """Whether a table's rows begin with commands that are not those of rest."""
    rows = any(held_rows(s.t, s.y) > 0 for s in inputs)
    return rows and any(s.before(start) != u for s, u in zip(inputs, rest, strict=True))


def stands_still(states: Sequence[Samples], rates: Sequence[str], until: int) -> bool:
    """Whether a robot was recorded before its first command, and did not move.

    Args:
        states: those that are measured; no state may drift, nor a rate be anything but zero.
        rates: names of the states that are velocities.
        until: the first command [ns].
    """
    for one in states:
        y = one.y[one.t < until]
        if len(y) < 2 * FEW or (until - one.t[0]) * 1e-9 < STILL_S:
            return False
        change, half = np.diff(y), len(y) // 2
        noise = float(np.sqrt((change**2).mean() / 2)) + STILL * float(np.ptp(one.y))
        drift = abs(float(y[half:].mean() - y[:half].mean()))
        off = abs(float(y.mean())) if one.name in rates else 0.0
        if max(drift, off) > NOISE * noise or np.ptp(y) > 2 * NOISE * noise:
            return False
    return bool(states)


def _steady(inputs: Sequence[Samples], changes: Ints, start: int, moved: int, dt: float) -> int:
    """From a start to the first step before which no command changed for a while."""
    first = max(int(s.t[0]) for s in inputs)
    length = min(LOOK_S, LOOK * 1e-9 * (max(int(s.t[-1]) for s in inputs) - start))
    quiet = max(STEADY_S, STEADY_STEPS * dt) * 1e9
    for k in range(int(length / dt)):
        at = start + moved + round(k * dt * 1e9)
        before = changes[changes < at - round(dt * 0.5e9)]
        if at - max(first, int(before[-1]) if len(before) else first) >= quiet:
            return at - start
    return moved
