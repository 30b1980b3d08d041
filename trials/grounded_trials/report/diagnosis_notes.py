"""What belongs to the numbers of a diagnosis: how they were held out, what +- leaves out, caveats.

Terminal and page show the same notes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from grounded.diagnosis.error_report import AT_MOST, furthest
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.ruler_words import in_doubt, open_noise, rest
from grounded.result import listed
from grounded_trials.report.diagnosis_words import agreement_lines, correction_line, error_lines
from grounded_trials.wording import percent

WHITE = 0.01  # p-value below which what is left is no longer taken for white noise
LEAST_SHARE = 0.005  # of the gap: a channel below it is not listed
CHANNELS, REGIONS = 2, 1  # named in a line
ELSEWHERE = ("utility", "alike")  # error lines that the page has in sections of their own


def held_out(found: Diagnosis) -> str:
    """Say how the errors were held out and what the noise floor is from."""
    row = found.prediction_error[0]
    by = {
        "groups": "each group of trials predicted with values from the others",
        "trials": "each trial predicted with values from the others",
        "pieces": "each piece of the log predicted with values from the others",
    }
    noise = {
        "repeats": "the scatter of repeats",
        AT_MOST: "at most the scatter of repeats, which holds what the model misses in each",
        "alike": "at most the scatter of trials whose commands agree to 2 %",
        "short horizon": "extrapolated from one-step errors",
    }
    if row.floor_at_most:
        noise["short horizon"] = (
            "the most it can be, perhaps far less: extrapolated from one-step errors, "
            "which hold errors of the model too (repeat a run to know it)"
        )
    text = f"{by.get(row.held_out, 'not held out')}; noise: {noise.get(row.floor_from, 'unknown')}"
    last = furthest(found.prediction_error)
    if last and any(one.drowned for one in found.prediction_error if not one.whole_trial):
        text += (
            f"; beyond {last.horizon_s:.3g} s noise alone grows past everything measured (as for a "
            "robot that falls without feedback), so errors of whole trials say little"
        )
    return text


def deviations(found: Diagnosis) -> str:
    """Say what the +- are, and what they leave out: errors of the equations themselves."""
    if found.leftover:
        return "+-: one standard deviation, but a gap remains, so true values may be further off"
    return "+-: one standard deviation, if the equations and the model's constants are right"


def caveats(found: Diagnosis) -> list[str]:
    """Return what these trials can't identify, except what the verdict says."""
    return [text for text in found.unknowable if text != found.verdict.limit]


def regions(found: Diagnosis, most: int = REGIONS) -> list[str]:
    """Return the regions with most of the gap, each with its share and how often it is visited."""
    return [
        f"{percent(one.share)} in the {percent(one.occupancy)} of the time in which {one.told}"
        for one in found.where.regions[:most]
    ]


def where_line(found: Diagnosis) -> str:
    """Say in which states and where most of the one-step errors are; "" if they are noise."""
    channels = [c for c in found.where.channels if c.share >= LEAST_SHARE]  # NaN: only noise
    if not channels:
        return ""
    parts = [f"{percent(c.share)} in {c.name}" for c in channels[:CHANNELS]]
    return f"of the one-step errors beyond the noise, {'; '.join([listed(parts), *regions(found)])}"


def left_patterns(found: Diagnosis) -> dict[str, float]:
    """Return by state the p-value of white noise in what is left, without states left out."""
    known = {one.name for one in found.where.channels if math.isfinite(one.rms)}
    return {name: p for name, p in found.where.whiteness.items() if not known or name in known}


def pattern_line(found: Diagnosis) -> str:
    """Say that what is left is as small as noise, but not noise only; "" if that is not so."""
    rows = found.prediction_error
    names = [name for name, p in left_patterns(found).items() if p < WHITE]
    if not names or found.leftover or rest(rows) or open_noise(rows) or in_doubt(rows):
        return ""
    return (
        f"what is left in {listed(names)} is as small as the noise, but has a pattern: part of it "
        "is not noise, too small a part to show in predictions"
    )


def note_lines(found: Diagnosis, before: Mapping[str, float]) -> list[tuple[str, str]]:
    """Return (title, text) of all notes to a diagnosis, with all terms of sums.

    Args:
        found: the result.
        before: values of the model's parameters before it.
    """
    lines = [("caveat", text) for text in caveats(found)]
    if found.no_cause:
        return lines
    told = error_lines(found, before, whole=True)
    lines += [line for line in told if line[0] not in ELSEWHERE]
    lines += agreement_lines(found)
    if found.prediction_error:
        lines.append(("errors", f"open loop, {held_out(found)}"))
    if found.effects:
        lines.append(("values", deviations(found)))
    if text := where_line(found):
        lines.append(("where", text))
    if text := pattern_line(found):
        lines.append(("pattern", text))
    if found.correction is not None and found.correction.adoptable:
        lines.append(("correction", correction_line(found.correction)))
    return lines
