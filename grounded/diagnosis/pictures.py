"""Figures of a diagnosis: predictions before and after, and the credit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.telling import columns_told
from grounded.figures.figure import Figure, Panel, bars, curve, legend, panel
from grounded.result import measured_alike, percent, shown

if TYPE_CHECKING:  # of which this is a part
    from grounded.diagnosis.parts import Diagnosis

MOST_BARS = 12  # bars
STATES = 6  # whose error without each cause is drawn
WHOLE = "whole trial"
APART_BY = 2.0  # where errors over whole trials are drawn, in units of the longest horizon
ROLES = {  # of the columns of prediction errors
    "outset": "limit",
    "crude": "model",
    "calibrated": "step1",
    "with_effects": "best",
    "noise_floor": "other",
}


def gap_figures(diagnosis: Diagnosis) -> list[Figure]:
    """Return the figures of a diagnosis, most important first; none if no cause can be named."""
    if diagnosis.no_cause:
        return []
    found = (accuracy_figure(diagnosis), credit_figure(diagnosis))
    return [figure for figure in found if figure is not None]


def accuracy_figure(diagnosis: Diagnosis) -> Figure | None:
    """Return the prediction errors without and with the diagnosis, in each state's unit."""
    errors = diagnosis.prediction_error
    if not errors:
        return None
    panels = _over_horizons(errors, columns_told(diagnosis))
    if not panels:
        return None
    caption = "" if errors[0].held_out != "no" else "not held out"
    key = tuple(sorted(legend(panels), key=lambda one: one.role == "other"))
    return Figure("accuracy", "Predictions before and after", caption, panels, key)


def _over_horizons(errors: Sequence[RulerRow], columns: Mapping[str, str]) -> list[Panel]:
    """Return one panel per state: its error over the horizon, and apart, that of whole trials."""
    units = errors[0].unit_by_channel
    panels: list[Panel] = []
    apart = APART_BY * max((e.horizon_s for e in errors if not e.whole_trial), default=1.0)
    at = np.array([apart if e.whole_trial else e.horizon_s for e in errors])
    whole = np.array([e.whole_trial for e in errors])
    ticks = [
        (float(x), WHOLE.replace(" ", "\n") if w else f"{x:.3g}")
        for x, w in zip(at, whole, strict=True)
    ]
    for channel, unit in units.items():
        curves = []
        for key, name in columns.items():
            values = np.array([getattr(e, key).get(channel, math.nan) for e in errors], float)
            for rows, note in ((~whole, ""), (whole, WHOLE)):
                if (values[rows] > 0).any():  # the axis is logarithmic
                    style = "line" if rows.sum() > 1 and not note else "points"
                    x, y = at[rows], values[rows]
                    curves.append(curve(x, y, ROLES[key], name, 2.0, style=style, note=note))
        if curves:
            curves.sort(key=lambda one: one["meta"]["role"] != "other")  # noise is drawn behind
            unit = shown(unit)
            label, across = f"{channel} [{unit}]" if unit else channel, "predicted ahead [s]"
            panels.append(panel(label, across, unit, curves, log=True, x_ticks=ticks))
    return panels


def credit_figure(diagnosis: Diagnosis, states: int = STATES) -> Figure | None:
    """Return each cause's share of the gain, and the errors of some states without each cause.

    Args:
        diagnosis: the diagnosis.
        states: largest number of states, those with the largest improvement first.
    """
    credit, ahead = diagnosis.credit, [e for e in diagnosis.prediction_error if not e.whole_trial]
    error = ahead[-1] if ahead and not ahead[-1].drowned else None
    changed = error.changes if error else {}
    names = sorted(changed, key=lambda name: changed[name])[:states]
    panels = [p for name in names if error and (p := worth_of(name, error, diagnosis))]
    if credit:
        shares = [(c.of, c.share, percent(c.share), "best") for c in credit[:MOST_BARS]]
        panels.insert(0, bars("Share of the gain", shares))
    return Figure("credit", "What each is worth", "", panels) if panels else None


def worth_of(name: str, error: RulerRow, diagnosis: Diagnosis) -> Panel | None:
    """Return the error of a state with all causes and all but each.

    If effects were adopted before, also that of the model without them.
    """
    causes = diagnosis.credit
    told = [(("limit", "model.py"), error.outset)]  # {} if it is so
    told += [(("model", "model"), error.crude)]
    if causes:  # else nothing was found: the same error once more
        told += [(("best", "all causes"), error.with_effects)]
    if len(causes) > 1:  # without the only one, it is the model before
        told += [(("limit", f"all but {c.of}"), c.without_it) for c in causes[:MOST_BARS]]
    told += [(("other", columns_told(diagnosis)["noise_floor"]), error.noise_floor)]
    known = [(look, errors[name]) for look, errors in told if name in errors]
    known = [(look, v) for look, v in known if math.isfinite(v)]
    texts = measured_alike([v for _, v in known], error.unit_by_channel.get(name, ""))
    rows = [(label, v, t, role) for ((role, label), v), t in zip(known, texts, strict=True)]
    return bars(f"{name}: error {error.horizon_s:.3g} s ahead", rows) if rows else None
