"""The figure of a search: utility and predicted utility by candidate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from grounded.figures import Figure, Panel, Trace, band, curve, marks, panel
from grounded.result import figure
from grounded.search.candidate import Tried

if TYPE_CHECKING:
    from grounded.search.standing import Standing

STEEP = 8.0  # ratio of worst to best utility from which on the axis is logarithmic
MOST_DRAWN = 300  # most candidates that are drawn
TICKS = 8  # most candidates named on an axis
PREDICTED = ("predicted", "dash", "predicted by the model")  # role, shape and name of its marks
OPEN = ("waiting", "in doubt", "no trial")  # undecided verdicts


def search_figure(now: Standing) -> Figure | None:
    """Draw the utility of each candidate with the model's prediction."""
    shown, left = few(now.history, MOST_DRAWN)
    tried = [t for t in shown if t.utilities]
    if not tried:
        return None
    number = {t.candidate.id: k + 1 for k, t in enumerate(now.history)}
    waits = [t for t in shown if not t.utilities and now.verdict(t) == "waiting"]
    stepped = any(t.candidate.grounded for t in shown)
    caption = (
        "Each candidate is run on the real system; it becomes the best so far if its utility, the "
        "sum of its rewards, is higher. A dash is the utility predicted by the model"
        + "; for all but the first candidate, it replays an earlier trial" * stepped
        + "."
    ) + f" {left} candidates in between are not drawn." * bool(left)
    return Figure("utility", "Utility", caption, (_utility(now, tried + waits, number),))


def few(history: Sequence[Tried], most: int) -> tuple[list[Tried], int]:
    """Select at most `most` candidates; return them and the number left out.

    Keeps the first and the last, then improvements (evenly spread if too many), then the latest.
    """
    if len(history) <= most:
        return list(history), 0
    keep = {0, len(history) - 1}
    accepted = [k for k, t in enumerate(history) if t.accepted]
    if len(accepted) > most - 2:
        index = np.unique(np.rint(np.linspace(0, len(accepted) - 1, most - 2)).astype(int))
        accepted = [accepted[i] for i in index]
    keep |= set(accepted)
    others = [k for k in reversed(range(len(history))) if k not in keep]
    keep |= set(others[: most - len(keep)])
    return [history[k] for k in sorted(keep)], len(history) - len(keep)


def _utility(now: Standing, tried: list[Tried], number: dict[str, int]) -> Panel:
    shapes, best = list[Trace](), now.incumbent
    if best is not None and 0 < best.standard_error < math.inf:
        error = 2 * best.standard_error
        ends = best.utility - error, best.utility + error
        shapes.append(band(*ends, "other", "±2 standard errors of the best"))
    dots = _marks(now, tried, number)
    values = [float(y) for one in dots for y in one["y"] if math.isfinite(y)]
    loss = bool(values) and max(values) < 0 and min(values) < STEEP * max(values)
    return panel(
        "Utility of each candidate" + (", logarithmic" if loss else ""),
        "candidate",
        "utility",
        [*_record(now.history, number), *dots],
        shapes,
        x_ticks=_named(now.history, number),
        loss=loss,
        x_range=(0.4, len(now.history) + 0.6),
    )


def _marks(now: Standing, tried: Sequence[Tried], number: dict[str, int]) -> list[Trace]:
    """Return the marks of what was predicted of each candidate, and of its runs by verdict."""
    looks: dict[tuple[str, str, str], list[Tried]] = {PREDICTED: []}
    for one in tried:
        if math.isfinite(one.promised) and not (one.utilities and one.utility == -math.inf):
            looks[PREDICTED].append(one)
        if one.utilities:
            looks.setdefault(_look(one, now.verdict(one)), []).append(one)
    found = []
    for (role, shape, name), some in looks.items():
        real, at = shape != PREDICTED[1], [number[one.candidate.id] for one in some]
        spreads = [one.standard_error for one in some]
        errors = [e if real and math.isfinite(e) else 0.0 for e in spreads]
        values = [one.utility if real else one.promised for one in some]
        notes = [_note(one, now.verdict(one)) for one in some]
        found.append(marks(at, values, role, notes, shape=shape, name=name, errors=errors))
    return [one for one in found if len(one["x"])]


def _note(tried: Tried, became: str) -> str:
    """Return what is shown of a candidate on hovering."""
    candidate = tried.candidate
    note = (
        f"{candidate.id}, iteration {candidate.iteration}, α = {candidate.alpha:g}\n"
        f"utility {figure(tried.utility)}, predicted {figure(tried.promised)}\n{became}"
    )
    if math.isfinite(error := tried.standard_error):
        note += f", ± {figure(error, 2)} over {len(tried.trials)} trials"
    return note


def _look(tried: Tried, verdict: str) -> tuple[str, str, str]:
    """Return role, shape and name of the mark of a candidate's runs."""
    if not math.isfinite(tried.utility):
        return "model", "cross", "crashed"
    if verdict in OPEN:
        return "predicted", "ring", "undecided"
    if tried.accepted:
        return "best", "disc", "first or better"
    return "other", "ring", "no better"


def _record(tried: Sequence[Tried], number: dict[str, int]) -> list[Trace]:
    """Return the curve of the best utility so far, as steps."""
    best, steps = -math.inf, []
    for t in tried:
        if t.accepted and t.utility > best:
            best = t.utility
            steps.append((float(number[t.candidate.id]), best))
    if not steps:
        return []
    at, values = np.array(steps).T
    x = np.append(np.repeat(at, 2)[1:], float(max(number.values())))
    return [curve(x, np.repeat(values, 2), "best", "best so far", 1.2)]


def _named(shown: Sequence[Tried], number: dict[str, int]) -> tuple[tuple[float, str], ...]:
    """Return the candidate ids on the axis, evenly thinned to at most TICKS."""
    kept = shown[:: -(-len(shown) // TICKS)]
    return tuple((float(number[t.candidate.id]), t.candidate.id) for t in kept)
