"""The figures of the diagnosis: where the gap is, which effects explain it, how far it shrinks."""

from __future__ import annotations

import math

from grounded_trials.diagnosis_file import Diagnosis, Share
from grounded_trials.figures import Bar, Bars, Figure
from grounded_trials.words import figure

MOST = 12


def gap_figure(diagnosis: Diagnosis | None) -> Figure | None:
    """Shares of the gap by channel, time and region; evidence; the gap before and after."""
    if diagnosis is None:
        return None
    panels = [
        Bars(title, _shares(shares, role))
        for title, shares, role in (
            ("Share of the gap by channel", diagnosis.channels, "best"),
            ("Share of the gap by time", diagnosis.times, "step2"),
            ("Share of the gap by region", diagnosis.regions, "accepted"),
        )
        if shares
    ]
    if diagnosis.ranking:
        panels.append(Bars("Evidence for an effect [nats]", _ranking(diagnosis)))
    if diagnosis.gap is not None:
        panels.append(_shrinkage(diagnosis))
    if not panels:
        return None
    caption = (
        "Evidence is the gain in log-likelihood less its price; an effect is claimed from 3 nats. "
        "The floor is what noise alone would leave."
    )
    return Figure("gap", "Gap between model and reality", caption, tuple(panels))


def _shares(shares: tuple[Share, ...], role: str) -> tuple[Bar, ...]:
    found = []
    for share in shares[:MOST]:
        text = f"{100 * share.share:.0f} %" + (f", {share.note}" if share.note else "")
        found.append(Bar(share.label, share.share, text, role))
    return tuple(found)


def _ranking(diagnosis: Diagnosis) -> tuple[Bar, ...]:
    named = set(diagnosis.effects)
    return tuple(
        Bar(r.effect, r.evidence, figure(r.evidence, 3), "best" if r.effect in named else "other")
        for r in diagnosis.ranking[:MOST]
    )


def _shrinkage(diagnosis: Diagnosis) -> Bars:
    gap = diagnosis.gap
    assert gap is not None
    title = f"Prediction error {gap.horizon_s:g} s ahead" if math.isfinite(gap.horizon_s) else "Gap"
    rows = (
        ("model", gap.before, "model"),
        ("as diagnosed", gap.after, "best"),
        ("noise alone", gap.floor, "other"),
    )
    return Bars(title, tuple(Bar(name, v, figure(v, 3), role) for name, v, role in rows))
