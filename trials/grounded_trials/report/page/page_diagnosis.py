"""The page's section on the gap: the diagnosis, the parts of the error, forecasts."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from grounded.diagnosis.report import ChannelParts, Diagnosis, Parts, Split
from grounded_trials.report.diagnosis_words import (
    WHITE,
    gap_sentence,
    horizons,
    main_horizon,
    parts_sentence,
    sentences,
    utility_sentence,
    whiteness_sentence,
)
from grounded_trials.report.figures.gap import forecast_figures, gap_figure
from grounded_trials.report.findings import Findings
from grounded_trials.report.page.page_tables import (
    command,
    effect_table,
    figure_block,
    forecast_table,
    leftover_table,
    table,
)
from grounded_trials.wording import percent, rendered
from grounded_trials.workspace.next_step import DIAGNOSE, Since


def gap_section(findings: Findings) -> str:
    """What was diagnosed, and forecasts of the crude model beside the better one."""
    diagnosis = findings.diagnosis
    if diagnosis is None:
        return (
            "<p>Not diagnosed yet. This says where the model is wrong, and which effect makes it "
            f"so: {command(rendered(DIAGNOSE), 'c-diagnose')}</p>{_forecasts(findings)}"
        )
    return _diagnosed(diagnosis, findings.since) + _forecasts(findings)


def _forecasts(findings: Findings) -> str:
    parts = [
        f"<h3>{escape(figure.title)}</h3>{figure_block(figure)}"
        for figure in forecast_figures(findings)
    ]
    return "".join([*parts, forecast_table(findings)])


def _diagnosed(diagnosis: Diagnosis, since: Since) -> str:
    parts = [verdict_block(diagnosis, since)]
    if diagnosis.no_cause:  # with too little data, what was fitted is no finding
        return "".join(parts)
    parts.append(figure_block(gap_figure(diagnosis)))
    if diagnosis.ranking:
        parts.append(f"<h3>Effects that were weighed</h3>{effect_table(diagnosis, since)}")
    parts.append(_alike(diagnosis))
    if diagnosis.leftover:
        parts.append(f"<h3>What no known effect explains</h3>{leftover_table(diagnosis)}")
    parts += [_made_of(diagnosis.where.split), _rest(diagnosis), _utility(diagnosis)]
    if diagnosis.gap.measured:
        parts.append(f'<p class="soft">Gap: {escape(gap_sentence(diagnosis.gap))}.</p>')
    return "".join(parts)


def verdict_block(diagnosis: Diagnosis, since: Since, *, short: bool = False) -> str:
    """The verdict, a line for each of its sentences; the first two of them where `short`.

    What happened since stands before it: it is no longer the last word then.
    """
    texts = sentences(diagnosis.sentence or diagnosis.kind)
    texts = texts[:2] if short else texts
    if since.adopted:
        texts[0] = f"Before that: {texts[0]}"
    if since.sentence:
        texts.insert(0, f"{_begun(since.sentence)}.")
    lines = " ".join(f"<span>{escape(text)}</span>" for text in texts)
    return f'<p class="verdict">{lines}</p>'


def _alike(diagnosis: Diagnosis) -> str:
    """Ties, and effects that would do nearly the same as one that is claimed."""
    parts = [
        f"<p>These data can’t tell apart: {escape(', '.join(group))}.</p>"
        for group in diagnosis.indistinguishable
    ]
    if diagnosis.lookalikes:
        rows = [(one.effect, one.like, percent(one.share)) for one in diagnosis.lookalikes]
        header = ("claimed effect", "look-alike ", "share")
        parts.append(
            "<h3>Look-alikes</h3><p>In these trials the look-alike, by itself, would make this "
            "share of what the claimed effect does. A trial in which the two differ settles it.</p>"
            + table("lookalikes", header, rows)
        )
    return "".join(parts)


def _made_of(splits: Mapping[str, Split]) -> str:
    """The squared error in three parts: at each horizon in all, and by state."""
    if not splits:
        return ""
    header = ("ahead", "explained", "unexplained", "noise")
    rows = [(words, *_shares(one.whole)) for words, one in horizons(splits)]
    ahead, main = main_horizon(splits)
    by_state = [(parts.name, *_shares(parts)) for parts in main.channels]
    repeated = any(one.irreducible_from == "repeats" for one in splits.values())
    source = "repeated trials" if repeated else "the estimated noise"
    return (
        f"<h3>What the error is made of</h3><p>{escape(_begun(parts_sentence(splits)))}. Explained "
        "is what the effects take away on trials that were held out, unexplained what they leave "
        f"above the noise; how large the noise is comes from {source}.</p>"
        + table("split", header, rows)
        + f"<details><summary>By state, {escape(ahead)} ahead</summary>"
        + table("split-states", ("state", *header[1:]), by_state)
        + "</details>"
    )


def _shares(parts: Parts | ChannelParts) -> tuple[str, str, str]:
    shares = (parts.explained, parts.unexplained, parts.irreducible)
    explained, unexplained, noise = (f"{100 * s:.1f} %" if s == s else "-" for s in shares)
    return explained, unexplained, noise


def _rest(diagnosis: Diagnosis) -> str:
    """Whether what the effects leave is noise, by state."""
    whiteness = diagnosis.where.whiteness
    if not whiteness:
        return ""
    rows = [
        (name, f"{p:.2g}" if p >= 1e-4 else "< 0.0001", "pattern" if p < WHITE else "white noise")
        for name, p in whiteness.items()
    ]
    return (
        "<h3>Is the rest noise?</h3>"
        f"<p>{escape(_begun(whiteness_sentence(whiteness)))}.</p>"
        + table("whiteness", ("state", "p (white noise)", "what is left "), rows)
    )


def _utility(diagnosis: Diagnosis) -> str:
    """How well the model, with and without the effects, predicts what the search judges by."""
    text = utility_sentence(diagnosis)
    return f"<h3>Utility, predicted</h3><p>{escape(_begun(text))}.</p>" if text else ""


def _begun(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
