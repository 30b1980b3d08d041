"""Figures of a diagnosis: predictions before and after, the credit, where the gap is."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from grounded.diagnosis.error_report import Credit, RulerRow, furthest
from grounded.diagnosis.parts import Diagnosed
from grounded.diagnosis.tables import larger, weighed_beside
from grounded.figures.figure import Bar, Bars, Curve, Figure, Panel, legend
from grounded.result import figure, listed, measured, measured_alike, number, percent, shown

MOST = 12  # bars
BEFORE = "before these causes"  # also where they were adopted since, or others before
ALL = "with all causes"
APART = 0.01  # relative difference of errors below which curves coincide
WHOLE = "whole trial"
APART_BY = 2.0  # where errors over whole trials are drawn, in units of the longest horizon
SHOWS = 1.02  # ratio of errors, such as without and with a cause, from which bars show it
SPARED = "All but: with every cause of this diagnosis except one, fitted again."
OFFSET = f" Where such a bar is longer than that of the model {BEFORE}, causes offset each other."
SHORTER = (
    " A cause is claimed for the mean over all states and horizons. If predictions of one state "
    "are better without it, its bar is shorter than that of all."
)
CREDIT_S = 1.0  # horizon at which an effect's worth is measured [s]
MODELS = {  # keys of a prediction error: role, name
    "outset": ("limit", "model.py"),
    "crude": ("model", "model"),
    "calibrated": ("step1", "calibrated"),
    "with_effects": ("best", "as diagnosed"),
    "noise_floor": ("other", "noise alone"),
}


def models(error: RulerRow) -> dict[str, tuple[str, str]]:
    """Return `MODELS`, with the noise labelled as a bound if it is one."""
    bound = {"noise_floor": ("other", "noise, at most")}
    return MODELS | bound if error.floor_bound else MODELS


def _told_apart(errors: Sequence[RulerRow]) -> dict[str, tuple[str, str]]:
    """Return `models`, merging those with the same errors everywhere: `model = as diagnosed`."""
    found: dict[str, tuple[str, str]] = {}
    for key, (role, name) in models(errors[0]).items():
        alike = (other for other in found if all(_same(e, key, other) for e in errors))
        other = next(alike, "")
        if other and key != "noise_floor":
            name = f"{found.pop(other)[1]} = {name}"
        found[key] = role, name
    return found


def _same(error: RulerRow, one: str, other: str) -> bool:
    """Check whether two columns coincide in a figure."""
    a, b = getattr(error, one), getattr(error, other)
    known = [n for n in a if n in b and math.isfinite(a[n]) and math.isfinite(b[n])]
    return bool(known) and all(math.isclose(a[n], b[n], rel_tol=APART) for n in known)


def gap_figures(diagnosis: Diagnosed) -> list[Figure]:
    """Return the figures of a diagnosis, most important first; none if no cause can be named."""
    if diagnosis.no_cause:
        return []
    found = (accuracy_figure(diagnosis), credit_figure(diagnosis, 6), where_figure(diagnosis))
    return [figure for figure in found if figure is not None]


def accuracy_figure(diagnosis: Diagnosed) -> Figure | None:
    """Return the prediction errors without and with the diagnosis, in each state's unit."""
    errors = diagnosis.prediction_error
    if not errors:
        panels: list[Panel | Bars] = [_shrinkage(diagnosis)] if diagnosis.gap.measured else []
        held, apart = diagnosis.gap.held_out, False
    else:
        apart = any(not e.whole_trial for e in errors) and len(errors) > 1
        panels = _over_horizons(errors) if apart else _by_channel(errors[0])
        held = errors[0].held_out != "no"
    if not panels:
        return None
    where = "on held-out data" if held else "on the data used for the diagnosis"
    least = " No model gets below the noise."
    if any(e.floor_bound for e in errors):
        least = " The noise is at most that, and perhaps far less: a better model may get below it."
    if apart and not any(v > 0 for e in errors for v in e.noise_floor.values()):
        known = any(v == 0 for e in errors for v in e.noise_floor.values())
        least = " Repeated trials agree exactly: the noise is 0." * known
    caption = f"Rms error of predictions, {where}.{least}"
    key = tuple(sorted(legend(panels), key=lambda one: one.role == "other"))
    return Figure("accuracy", "Predictions before and after", caption, tuple(panels), key)


def _over_horizons(errors: Sequence[RulerRow]) -> list[Panel | Bars]:
    """Return one panel per state: its error over the horizon, and apart, that of whole trials."""
    units = errors[0].unit_by_channel
    panels: list[Panel | Bars] = []
    ahead = np.array([e.horizon_s for e in errors if not e.whole_trial])
    at = np.array([APART_BY * ahead.max() if e.whole_trial else e.horizon_s for e in errors])
    whole = np.array([e.whole_trial for e in errors])
    ticks = [
        (float(x), WHOLE.replace(" ", "\n") if w else f"{x:.3g}")
        for x, w in zip(at, whole, strict=True)
    ]
    for channel, unit in units.items():
        curves = []
        for key, (role, name) in _told_apart(errors).items():
            values = np.array([getattr(e, key).get(channel, math.nan) for e in errors], float)
            for rows, note in ((~whole, ""), (whole, WHOLE)):
                if (values[rows] > 0).any():  # the axis is logarithmic
                    style = "line" if rows.sum() > 1 and not note else "points"
                    curves.append(
                        Curve(at[rows], values[rows], role, name, 2.0, style=style, note=note)
                    )
        if curves:
            curves.sort(key=lambda curve: curve.role != "other")  # noise is drawn behind
            unit = shown(unit)
            label, across = f"{channel} [{unit}]" if unit else channel, "predicted ahead [s]"
            panels.append(Panel(label, across, unit, tuple(curves), log=True, x_ticks=tuple(ticks)))
    return panels


def _by_channel(error: RulerRow) -> list[Panel | Bars]:
    panels: list[Panel | Bars] = []
    for channel, unit in error.unit_by_channel.items():
        bars = []
        for key, (role, name) in models(error).items():
            value = getattr(error, key).get(channel, math.nan)
            if math.isfinite(value):
                bars.append((name, value, role))
        if bars:
            when = WHOLE if error.whole_trial else f"{error.horizon_s:.3g} s ahead"
            panels.append(Bars(f"{channel}, {when}", _in_unit(bars, unit)))
    return panels


def _in_unit(bars: Sequence[tuple[str, float, str]], unit: str) -> tuple[Bar, ...]:
    """Return bars of (name, error, role) whose texts share one unit."""
    texts = measured_alike([value for _, value, _ in bars], unit)
    return tuple(Bar(n, v, text, role) for (n, v, role), text in zip(bars, texts, strict=True))


def credit_figure(diagnosis: Diagnosed, channels: int = 1) -> Figure | None:
    """Return how much larger errors are without each effect and without calibration.

    Args:
        diagnosis: the diagnosis.
        channels: number of states for which errors without each cause are drawn, in their unit;
            those with the largest improvement first.
    """
    credit, known = diagnosis.credit, _second_ahead(diagnosis)
    if not credit:
        return None
    bars = tuple(Bar(c.of, c.share, larger(c.times) or percent(c.share)) for c in credit[:MOST])
    panels = [Bars("Errors without each, mean of all (logarithmic)", bars)]
    for name in _improved(known)[:channels] if known else ():
        panels += worth_of([name], name, diagnosis)
    caption = _all_but(panels[1:]) * (len(credit) > 1)
    return Figure("credit", "What each is worth", caption, tuple(panels))


def worth_figure(
    diagnosis: Diagnosed, groups: Sequence[tuple[Sequence[str], str]]
) -> Figure | None:
    """Return the prediction errors without each cause, for some states.

    A cause is claimed for the mean over all states and horizons. If predictions of the given states
    lose nothing without it, the state that loses most is drawn, too. A cause that shows in no state
    a second ahead is named in the caption.

    Args:
        diagnosis: the diagnosis.
        groups: names of states with one unit, and a label for them together.

    Returns:
        The figure, or None if no error a second ahead is known.
    """
    error, drawn, hidden = _second_ahead(diagnosis), list(groups), []
    if error is None:
        return None
    for credit in diagnosis.credit[:MOST]:
        if any(_loss(credit, error, names) > SHOWS for names, _ in drawn):
            continue
        most = max(error.with_effects, key=lambda name: _loss(credit, error, [name]), default="")
        if most and _loss(credit, error, [most]) > SHOWS:
            drawn.append(([most], most))
        else:
            hidden.append(credit.of)
    panels = [panel for names, what in drawn for panel in worth_of(names, what, diagnosis)]
    caption = _all_but(panels) * (len(diagnosis.credit) > 1)
    caption += (
        f" The improvement by {', '.join(hidden)} shows at other horizons, in no state 1 s ahead."
    ) * bool(hidden)
    return Figure("credit", "", caption.strip(), tuple(panels)) if panels else None


def _all_but(panels: Sequence[Bars]) -> str:
    """What the bars of all causes but one say where they are unusually long or short."""
    longer = shorter = False
    for panel in panels:
        by = {bar.label: bar.value for bar in panel.bars}
        without = [value for name, value in by.items() if name.startswith("all but")]
        longer |= max(without, default=0.0) > SHOWS * by.get(f"model {BEFORE}", math.inf)
        shorter |= SHOWS * min(without, default=math.inf) < by.get(ALL, 0.0)
    return (SPARED + OFFSET * longer + SHORTER * shorter) * bool(panels)


def _loss(credit: Credit, error: RulerRow, names: Sequence[str]) -> float:
    """Return the ratio of errors without and with a cause, 0 if it is not known."""
    if not set(names) <= set(credit.without_it) & set(error.with_effects):
        return 0.0
    without, whole = (
        math.hypot(*(v[n] for n in names)) for v in (credit.without_it, error.with_effects)
    )
    return without / whole if whole > 0 else 0.0


def worth_of(names: Sequence[str], what: str, diagnosis: Diagnosed) -> list[Bars]:
    """Return the combined error of some states a second ahead, with all causes and all but each.

    If effects were adopted before, also that of the model without them.

    Args:
        names: names of states with one unit, such as those of a position.
        what: their label.
        diagnosis: the diagnosis.

    Returns:
        One panel, or none if an error is not known.
    """
    error = _second_ahead(diagnosis)
    if error is None or not set(names) <= set(error.crude):
        return []
    unit = error.unit_by_channel.get(names[0], "")
    said = BEFORE if diagnosis.credit else "with what was adopted" if error.outset else "as it is"
    rows = [((MODELS["outset"][0], "model.py, nothing adopted"), error.outset)]  # {} if it is so
    rows += [(("model", f"model {said}"), error.crude)]
    if diagnosis.credit:  # else nothing was found: the same error once more
        rows += [(("best", ALL), error.with_effects)]
    if len(diagnosis.credit) > 1:  # without the only one, it is the model before
        rows += [(("limit", f"all but {c.of}"), c.without_it) for c in diagnosis.credit[:MOST]]
    rows += [(models(error)["noise_floor"], error.noise_floor)]
    found = [(look, math.hypot(*(v[n] for n in names))) for look, v in rows if set(names) <= set(v)]
    bars = _in_unit([(n, v, role) for (role, n), v in found if math.isfinite(v)], unit)
    if not bars:  # the state was never measured
        return []
    title = what.removeprefix("the ").capitalize() if len(names) > 1 else what
    return [Bars(f"{title}: error {error.horizon_s:.3g} s ahead", bars)]


def _second_ahead(diagnosis: Diagnosed) -> RulerRow | None:
    errors = diagnosis.prediction_error
    horizons = [e for e in errors if not e.whole_trial]
    if horizons and horizons[0].horizon_s > CREDIT_S / 2:  # a slow process
        return furthest(horizons)
    ahead = (e for e in errors if math.isclose(e.horizon_s, CREDIT_S, rel_tol=0.1))
    return next((e for e in ahead if not e.drowned), None)


def _improved(error: RulerRow) -> list[str]:
    """Return the states by how much better they are predicted, best first."""
    gain = {
        name: error.crude[name] / max(after, 1e-300)
        for name, after in error.with_effects.items()
        if error.crude.get(name) and math.isfinite(error.crude[name])
    }
    return sorted(gain, key=lambda name: -gain[name])


def where_figure(diagnosis: Diagnosed) -> Figure | None:
    """Return the shares of the gap by channel, time and region, and the evidence for effects."""
    where = diagnosis.where
    by_channel = [
        (c.name, c.share, f", {measured(c.rms, c.unit)}" * math.isfinite(c.rms))
        for c in where.channels
        if math.isfinite(c.share)
    ]
    by_time = [(f"{t.start:.4g} to {t.end:.4g} s", t.share, "") for t in where.times]
    by_region = [(r.told, r.share, f", {percent(r.occupancy)} of the time") for r in where.regions]
    panels = [
        Bars(f"Share of the gap by {word}", _shares(shares, role))
        for word, shares, role in (
            ("channel", by_channel, "best"),
            ("time", by_time, "step2"),
            ("region", by_region, "accepted"),
        )
        if shares
    ]
    if diagnosis.ranking:
        panels.append(Bars("Evidence for an effect [nats]", _ranking(diagnosis)))
    if not panels:
        return None
    located = by_channel or by_time or by_region
    caption = "Shares are of the squared one-step errors beyond the noise." * bool(located)
    if by_channel:
        caption += f" Beside a channel's share: the model's prediction error{_ahead(diagnosis)}."
    if diagnosis.ranking:
        caption += f" {_evidence_words(diagnosis)}"
    title = "Where the gap is" if located else "Effects compared"
    return Figure("gap", title, caption.strip(), tuple(panels))


def _evidence_words(diagnosis: Diagnosed) -> str:
    """What the lengths and colours of the bars of evidence mean."""
    beside = weighed_beside(diagnosis) - {*diagnosis.effects}
    tied = listed([r.effect for r in diagnosis.ranking[:MOST] if r.effect in beside])
    words = "Evidence is the gain in log-likelihood less a price for parameters. "
    if diagnosis.effects:
        words += "Blue: the loss without a claimed effect, 3 nats or more. "
    words += "Grey: the gain of another effect alone"
    if diagnosis.effects:
        words += ", in place of all claimed ones, so compare it with other grey bars only"
    words += "; below 0, it is not worth its parameters."
    return words + f" {tied}: beside the other claimed effects, in place of a tied one." * bool(
        tied
    )


def _ahead(diagnosis: Diagnosed) -> str:
    """Return the horizon at which errors by channel are measured, as text."""
    row = furthest(diagnosis.prediction_error)
    return f" {row.horizon_s:.3g} s ahead, rms" if row else ", rms"


def _shares(shares: Sequence[tuple[str, float, str]], role: str) -> tuple[Bar, ...]:
    """Return bars of (label, share, note)."""
    return tuple(
        Bar(label, share, f"{percent(share)}{note}", role) for label, share, note in shares[:MOST]
    )


def _ranking(diagnosis: Diagnosed) -> tuple[Bar, ...]:
    named = set(diagnosis.effects)
    return tuple(
        Bar(r.effect, r.evidence, figure(r.evidence, 3), "best" if r.effect in named else "other")
        for r in diagnosis.ranking[:MOST]
    )


def _shrinkage(diagnosis: Diagnosed) -> Bars:
    gap = diagnosis.gap
    ahead = f" {gap.horizon_s:.3g} s ahead" if math.isfinite(gap.horizon_s) else ""
    rows = (
        ("model", gap.before, "model"),
        ("as diagnosed", gap.after, "best"),
        ("noise alone", gap.floor, "other"),
    )
    bars = tuple(Bar(name, v, number(v), role) for name, v, role in rows)
    return Bars(f"Prediction error{ahead}, in units of the noise", bars)
