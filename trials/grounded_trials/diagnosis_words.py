"""What a diagnosis says of the error itself, as sentences for terminal and page.

explained      what the effects take away on held-out trials
unexplained    what they leave above the noise
noise          what no model predicts
"""

from __future__ import annotations

import math
import re

from grounded_trials.diagnosis_error import Split, coloured
from grounded_trials.diagnosis_file import Diagnosis
from grounded_trials.words import count, figure, percent


def error_lines(diagnosis: Diagnosis) -> list[tuple[str, str]]:
    """(title, text): what the error is made of, whether the rest is noise, the utility, doubles."""
    found = []
    if diagnosis.split:
        found.append(("error", parts_sentence(diagnosis.split)))
    if diagnosis.whiteness:
        found.append(("rest", whiteness_sentence(diagnosis.whiteness)))
    if diagnosis.utility_prediction is not None:
        found.append(("utility", utility_sentence(diagnosis)))
    for effect in dict.fromkeys(one.effect for one in diagnosis.lookalikes):
        like = [
            f"{one.like} {'makes ' * (k == 0)}{percent(one.share)}"
            for k, one in enumerate(o for o in diagnosis.lookalikes if o.effect == effect)
        ]
        found.append(("alike", f"{', '.join(like)} of the signal of {effect}"))
    return found


def main_horizon(splits: tuple[Split, ...]) -> Split:
    """The horizon that the gap is measured at."""
    return next((one for one in splits if one.key == "horizon"), splits[0])


def parts_sentence(splits: tuple[Split, ...]) -> str:
    """`1 s ahead 99.7 % of the squared error is explained, 0.1 % is not, 0.2 % is noise`."""
    main = main_horizon(splits)
    parts = main.whole
    return (
        f"{main.ahead} ahead, {percent(parts.explained)} of the squared error is explained, "
        f"{percent(parts.unexplained)} is not, {percent(parts.irreducible)} is noise"
    )


def whiteness_sentence(whiteness: tuple[tuple[str, float], ...]) -> str:
    """Whether what the effects leave of each state is noise, or still has a pattern."""
    names, total = coloured(whiteness), len(whiteness)
    if not names:
        return "what is left of every state looks like white noise (Ljung-Box, p >= 0.01)"
    which = "every state" if len(names) == total else f"{', '.join(names)}"
    return (
        f"what is left of {which} is no white noise (Ljung-Box, p < 0.01): "
        "a part of it follows a pattern that is not in the model"
    )


def utility_sentence(diagnosis: Diagnosis) -> str:
    """How well utilities of whole trials are predicted; "" where none was."""
    found = diagnosis.utility_prediction
    if found is None:
        return ""
    crude, better = (
        f"by {figure(value, 3)}" if math.isfinite(value) else "beyond all measure"
        for value in (found.before, found.after)
    )
    text = f"the crude model misses the utility of {count(found.trials, 'whole trial')} {crude}"
    if diagnosis.effects:
        text += f", the diagnosed one {better}"
    return f"{text} (rms; the trials themselves scatter by {figure(found.spread, 3)})"


def sentences(text: str) -> list[str]:
    """A verdict's sentences, for a line each: they say different things."""
    return re.split(r"(?<=\.) (?=[A-Z`])", text)
