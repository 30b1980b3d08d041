"""The figure of a search: utility and predicted utility by candidate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from grounded.figures.figure import Dot, Figure, Key, Panel, Trace, band, curve, panel
from grounded.result import figure
from grounded.search.candidate import Tried

if TYPE_CHECKING:
    from grounded.search.standing import Standing

STEEP = 8.0  # ratio of worst to best utility from which on the axis is logarithmic
MOST_DRAWN = 300  # most candidates that are drawn
TICKS = 8  # most candidates named on an axis
OPEN = ("waiting", "in doubt", "no trial")  # undecided verdicts


def search_figure(now: Standing) -> Figure | None:
    """Draw the utility of each candidate with the model's prediction."""
    shown, left = few(now.history, MOST_DRAWN)
    tried = [t for t in shown if t.utilities]
    if not tried:
        return None
    number = {t.candidate.id: k + 1 for k, t in enumerate(now.history)}
    waits = [t for t in shown if not t.utilities and now.verdict(t) == "waiting"]
    whole = _utility(now, tried + waits, number)
    unsure = any(now.verdict(t) == "maybe better" for t in shown)
    key = [
        Key("best", f"first{', maybe better' * unsure} or better", "disc"),
        Key("other", "no better", "ring"),
        *[Key("predicted", "undecided", "ring")] * any(now.verdict(t) in OPEN for t in shown),
        Key("predicted", "predicted by the model", "dash"),
        Key("best", "best so far"),
    ]
    if any(not math.isfinite(t.utility) for t in tried):
        key.append(Key("model", "crashed", "cross"))
    if any(shape["type"] == "rect" for shape in whole.layout["shapes"]):
        key.append(Key("other", "±2 standard errors of the best", "band"))
    stepped = any(t.candidate.grounded for t in shown)
    caption = (
        "Each candidate is run on the real system; it becomes the best so far if its utility, the "
        "sum of its rewards, is higher. A dash is the utility predicted by the model"
        + "; for all but the first candidate, it replays an earlier trial" * stepped
        + "."
    ) + f" {left} candidates in between are not drawn." * bool(left)
    return Figure("utility", "Utility", caption, (whole,), tuple(key))


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
    dots = [d for t in tried for d in _dots(t, number[t.candidate.id], now.verdict(t))]
    shapes = list[Trace]()
    values = [d.y for d in dots if math.isfinite(d.y)]
    best = now.incumbent
    if best is not None and 0 < best.standard_error < math.inf:
        error = 2 * best.standard_error
        shapes.append(band(best.utility - error, best.utility + error, "other"))
    loss = bool(values) and max(values) < 0 and min(values) < STEEP * max(values)
    return panel(
        "Utility of each candidate" + (", logarithmic" if loss else ""),
        "candidate",
        "utility",
        _record(now.history, number),
        dots,
        shapes,
        x_ticks=_named(now.history, number),
        loss=loss,
        whole=True,
    )


def _dots(tried: Tried, at: int, became: str) -> list[Dot]:
    candidate = tried.candidate
    real = figure(tried.utility)
    note = (
        f"{candidate.id}, iteration {candidate.iteration}, α = {candidate.alpha:g}\n"
        f"utility {real}, predicted {figure(tried.promised)}\n{became}"
    )
    expected = Dot(at, tried.promised, "predicted", note, "dash")
    if not tried.utilities:
        return [expected] if math.isfinite(tried.promised) else []
    error = tried.standard_error
    if math.isfinite(error):
        note += f", ± {figure(error, 2)} over {len(tried.trials)} trials"
    if not math.isfinite(tried.utility):
        return [Dot(at, math.nan, "model", f"{note}: the run failed", "cross")]
    shape, role = _look(tried, became)
    dots = [Dot(at, tried.utility, role, note, shape, error if math.isfinite(error) else 0.0)]
    if math.isfinite(tried.promised):
        dots.insert(0, expected._replace(note=note))
    return dots


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
    return [curve(x, np.repeat(values, 2), "best", "", 1.2)]


def _named(shown: Sequence[Tried], number: dict[str, int]) -> tuple[tuple[float, str], ...]:
    """Return the candidate ids on the axis, evenly thinned to at most TICKS."""
    kept = shown[:: -(-len(shown) // TICKS)]
    return tuple((float(number[t.candidate.id]), t.candidate.id) for t in kept)


def _look(tried: Tried, verdict: str) -> tuple[str, str]:
    """Return (shape, role) of a candidate's mark."""
    if verdict in OPEN:
        return "ring", "predicted"
    return ("disc", "best") if tried.accepted else ("ring", "other")
