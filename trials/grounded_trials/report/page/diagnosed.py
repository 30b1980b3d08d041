"""The page's section on the diagnosis: predictions before and after it, then the details."""

from __future__ import annotations

from collections.abc import Mapping

from grounded.diagnosis.cause_words import give_or_take
from grounded.diagnosis.error_report import AT_MOST, ChannelParts, Parts, Split, doubt_of
from grounded.diagnosis.parts import Estimate, TrialValue
from grounded.diagnosis.pictures import accuracy_figure, credit_figure, where_figure
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.tables import of_delays, of_rivals
from grounded.diagnosis.verdict import told_apart
from grounded.result import begun
from grounded_trials.report.diagnosis_notes import WHITE, left_patterns, pattern_line
from grounded_trials.report.diagnosis_words import (
    gap_sentence,
    in_vain,
    made_from,
    utility_sentence,
    verdict_lines,
)
from grounded_trials.report.figures.gap import forecast_figures, residual_figures
from grounded_trials.report.findings import Findings
from grounded_trials.report.page.tables import (
    Block,
    drawn,
    effect_table,
    forecast_table,
    leftover_table,
    table,
)
from grounded_trials.report.settled import so_far
from grounded_trials.wording import percent, rendered
from grounded_trials.workspace.last_diagnosis import Since
from grounded_trials.workspace.next_step import DIAGNOSE

MOST = 6  # states whose error without each effect is drawn
DIGITS = 3  # of a share, which is printed to 0.1 %
ZERO = "0.0 %"
NOTHING = {"-", ZERO}  # shares that say nothing
NO_TRIAL = "Nothing to diagnose yet: no trial and no log of data is stored."
HORIZONS = {"one_step": "one step", "horizon": "{}", "whole_run": "whole run ({})"}


def gap_section(findings: Findings) -> list[Block]:
    """What was diagnosed, and forecasts of the crude model beside the better one."""
    diagnosis = findings.diagnosis
    ahead = [b for each in forecast_figures(findings) for b in drawn(each, title=True)]
    lacking = [b for each in residual_figures(findings) for b in drawn(each, title=True)]
    if diagnosis is None:
        if not (findings.runs or findings.logs):
            return [Block("text", NO_TRIAL)]
        words = "Not diagnosed yet. This says where the model is wrong, and what makes it so:"
        command = Block("command", rendered(DIAGNOSE, findings.folder), "c-diagnose")
        return [Block("text", words), command, *ahead, *forecast_table(findings), *lacking]
    causes, others = verdict_lines(diagnosis)
    shown = so_far(diagnosis, findings.since, findings.settled)[-1:]  # the page begins with more
    items = frozenset(range(len(shown), len(shown) + len(causes)))
    verdict = Block("verdict", lines=[*shown, *causes, *others], strong=items)
    if diagnosis.no_cause:  # with too little data, what was fitted is no finding
        return [verdict, *ahead, *forecast_table(findings), *lacking]
    proof = drawn(accuracy_figure(diagnosis), title=True)
    proof += drawn(credit_figure(diagnosis, MOST), title=True)
    proof += [*ahead, *forecast_table(findings)]
    return [verdict, *proof, *lacking, *_details(diagnosis, findings.since)]


def _details(diagnosis: Diagnosis, since: Since) -> list[Block]:
    found = drawn(where_figure(diagnosis), title=True)
    if diagnosis.ranking:
        found += [Block("heading", "Effects that were compared"), effect_table(diagnosis, since)]
        found += [Block("text", f"{text}.") for text in in_vain(diagnosis)]
        notes = (of_rivals(diagnosis), of_delays(diagnosis))
        found += [Block("text", f"{_begun(text)}.") for text in notes if text]
    found += _alike(diagnosis) + _by_trial(diagnosis)
    found += leftover_table(diagnosis)
    away = any(row.runs_away for row in diagnosis.prediction_error if row.whole_trial)
    split = {k: v for k, v in diagnosis.where.split.items() if k != "whole_run" or not away}
    found += _made_of(split) + _rest(diagnosis)
    if text := utility_sentence(diagnosis):
        found += [Block("heading", "Utility, predicted"), Block("text", f"{_begun(text)}.")]
    if diagnosis.made is not None:
        found.append(Block("soft", f"This diagnosis was {made_from(diagnosis)}."))
    if diagnosis.gap.measured:
        found.append(Block("soft", f"Gap: {gap_sentence(diagnosis.gap)}."))
    return found


def _by_trial(diagnosis: Diagnosis) -> list[Block]:
    """Whether every trial asks for the same value."""
    found = diagnosis.per_trial
    if not found:
        return []
    from grounded.diagnosis.validation.agreement import APART  # imports the effects

    rows = [
        (
            p.effect,
            p.quantity,
            p.trial,
            give_or_take(Estimate(p.value, p.std, unit=_unit(diagnosis, p))),
            "yes" if p.agrees else "no",
        )
        for p in found
    ]
    header = ("effect", "quantity ", "trial ", "value", "agrees with the others")
    strong = [i for i, p in enumerate(found) if not p.agrees]
    each = table("per-trial", header, rows, strong)
    words = (
        "Linear estimates from one trial each, all other values held. A trial that hardly shows an "
        "effect may give a value that is not possible, with a large standard deviation. Trials "
        f"agree if they scatter by at most {percent(APART)} of the value more than their ± tells."
    )
    blocks = [Block("soft", words), each]
    return [Block("folded", "Trial by trial", blocks=blocks, wide=bool(strong))]


def _unit(diagnosis: Diagnosis, value: TrialValue) -> str:
    row = diagnosis.ranked(value.effect)
    known = {**diagnosis.parameters, **({} if row is None else row.params)}
    return known[value.quantity].unit if value.quantity in known else ""


def _alike(diagnosis: Diagnosis) -> list[Block]:
    """Ties, and effects that would do nearly the same as one that is claimed."""
    found = [
        Block("text", f"{told_apart(group, diagnosis.equivalent, diagnosis.effects)}.")
        for group in diagnosis.indistinguishable
    ]
    if diagnosis.lookalikes:
        rows = [(one.effect, one.like, percent(one.share)) for one in diagnosis.lookalikes]
        words = (
            "In these trials the look-alike alone reproduces this share of the signal of the "
            "claimed effect. Only a trial in which the two act differently tells them apart."
        )
        found += [Block("heading", "Look-alikes"), Block("text", words)]
        found.append(table("lookalikes", ("claimed effect", "look-alike ", "share"), rows))
    return found


def _made_of(splits: Mapping[str, Split]) -> list[Block]:
    """The squared error in three parts: at each horizon in all, and by state.

    Nothing if no part is known, and one sentence if all of it is noise.
    """
    if not splits:
        return []
    bound = any(one.bound for one in splits.values())
    least = any(one.irreducible_from == "at most" for one in splits.values())
    header = (
        *("ahead", "explained", "unexplained" + ", at least" * least),
        "noise" + ", at most" * bound,
    )
    named = {
        key: words.format(f"{one.horizon_s:.3g} s")
        for key, words in HORIZONS.items()
        if (one := splits.get(key)) is not None
    }
    rows = [(words, *_shares(splits[key], splits[key].whole)) for key, words in named.items()]
    main = "horizon" if "horizon" in named else next(iter(named))
    by_state = [(parts.name, *_shares(splits[main], parts)) for parts in splits[main].channels]
    known = {"repeats": "the scatter of repeated trials"}
    known["alike"] = "the scatter of trials whose commands agree to 2 %, and is at most that"
    known[AT_MOST] = (
        "the scatter of repeated trials, which holds how much the model misses in each as well, so "
        "it is at most that"
    )
    known["at most"] = (
        "one-step errors, which hold errors of the model too, so it may be far less; then as much "
        "more is unexplained. Repeat a run to know"
    )
    source = known.get(splits[main].irreducible_from, "the estimated noise")
    rows = [row for row in rows if {*row[1:]} != {"-"}]
    by_state = [row for row in by_state if not NOTHING.issuperset(row[1:])]  # left out of it
    cells = [row[1:] for row in [*rows, *by_state]]
    if NOTHING.issuperset(cell for row in cells for cell in row):
        return []
    if all(row[:2] == (ZERO, ZERO) for row in cells):
        words = (
            f"Errors of held-out predictions are within the noise, which is taken from {source}."
        )
        return [Block("heading", "What the error is made of"), Block("text", words)]
    words = (
        "Explained: the share of the squared error of held-out predictions that the effects "
        f"remove. Unexplained: what they leave above the noise. The noise is taken from {source}."
    )
    if any("≤" in cell for row in [*rows, *by_state] for cell in row):
        words += (
            f" ≤{' and ≥' * (not bound)}: the noise is not known well enough to tell errors of up "
            f"to {_doubts(splits)} from noise, so what is unexplained may be noise too."
        )
    each = table("split-states", ("state", *header[1:]), by_state)
    folded = Block("folded", f"By state, {named[main]} ahead", blocks=[each])
    return [
        Block("heading", "What the error is made of"),
        Block("text", words),
        *[table("split", header, rows)] * bool(rows),
        *[folded] * bool(by_state),
    ]


def _shares(split: Split, parts: Parts | ChannelParts) -> tuple[str, str, str]:
    shares = (parts.explained, parts.unexplained, parts.irreducible)
    explained, unexplained, noise = map(percent, shares)
    if split.irreducible_from == "at most":  # the column says "unexplained, at least"
        return explained, percent(round(parts.unexplained, DIGITS)), noise
    if not _unsure(split, parts):
        return explained, unexplained, noise
    if split.bound:  # the column says "noise, at most"
        return explained, f"≤ {unexplained}", percent(parts.unexplained + parts.irreducible)
    return explained, f"≤ {unexplained}", f"≥ {percent(round(parts.irreducible, DIGITS))}"


def _unsure(split: Split, parts: Parts | ChannelParts) -> bool:
    """Check whether what is unexplained can be seen in the table, and may be noise too."""
    return round(parts.unexplained, DIGITS) > 0 and split.may_be_noise(parts)


def _doubts(splits: Mapping[str, Split]) -> str:
    """Up to how many times the noise errors may be noise: 1.3, more where repeats are few."""
    unsure = [
        one
        for one in splits.values()
        if _unsure(one, one.whole) or any(_unsure(one, state) for state in one.channels)
    ]
    factors = [doubt_of(one.irreducible_unsure) for one in unsure]
    ends = dict.fromkeys(f"{factor:.2g}" for factor in (min(factors), max(factors)))
    return f"{' to '.join(ends)} times its estimate{', by horizon,' * (len(ends) > 1)}"


def _rest(diagnosis: Diagnosis) -> list[Block]:
    """Whether what the effects leave is noise, by state, without those that were left out."""
    whiteness = left_patterns(diagnosis)
    if not whiteness:
        return []
    rows = [
        (name, f"{p:.2g}" if p >= 1e-4 else "< 0.0001", "pattern" if p < WHITE else "white noise")
        for name, p in whiteness.items()
    ]
    return [
        Block("heading", "Is there a pattern in the rest?"),
        Block(
            "text",
            f"White noise (Ljung-Box, p >= {WHITE:g}) is what no model could predict. Tested is "
            "what a filter that allows for the sensors' noise leaves of all trials.",
        ),
        table("whiteness", ("state", "p (white noise)", "what is left "), rows),
        *[Block("text", f"{_begun(text)}.") for text in [pattern_line(diagnosis)] if text],
    ]


def _begun(sentence: str) -> str:
    return begun(sentence)
