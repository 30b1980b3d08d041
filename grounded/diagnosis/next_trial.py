"""What to run next: the trial that would tell more, or why none is needed."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

from grounded.diagnosis.parts import Unconfirmed
from grounded.diagnosis.verdict import parameters_off, tied, told_apart
from grounded.model import all_at_bounds
from grounded.result import listed, number

if TYPE_CHECKING:  # whoever reads a verdict needs none of what makes it
    from grounded.diagnosis.validation.claims import Claims

LOG, LOST = "is a log that no candidate made", "failed"  # why a trial can't be repeated
CHANGED = (  # advice on the next trial if two groups differ
    "No trial is needed yet: the robot changed between the two groups, so adopt no value of both. "
    "Diagnose the newer trials alone, or discard the older ones."
)
AT_BOUNDS = (  # the same if every parameter that moved is at its bound
    "No trial helps yet: parameters stopped at their bounds and the data ask to go further. Widen "
    "the bounds in the model file if the true value may lie beyond; otherwise a parameter that the "
    "model holds constant may be off, so give it bounds. Then diagnose again."
)
AS_A_RATIO = (  # the same if an input acts the other way round as well
    "No trial is needed yet: {flip} acts the other way round. Its strength and the parameters that "
    "stopped at their bounds are known as a ratio only: flip its sign in model.py, or, if only the "
    "log has it so, multiply the scale in [log.input.{flip}] by -1 (a missing one is 1), and "
    "[limits] if they were taken from the log, discard the trials and ingest their logs again. "
    "Then diagnose again."
)


def next_trial(
    claims: Claims,
    look: str,
    groups: tuple[tuple[str, ...], ...],
    seen: Sequence[Unconfirmed] = (),
    same: tuple[tuple[str, ...], ...] = (),
    unrepeatable: Mapping[str, str] | None = None,
    worse: str = "",
    adopted: Collection[str] = (),
    ended: bool = False,
    flip: str = "",
    noise: bool = False,
) -> str:
    """Return a sentence on the next trial; `excitation.probe` designs the trial itself.

    Args:
        claims: the causes that are claimed.
        look: what to run because of a gap without a cause, or because all that is left may be
            `noise`; "" if there is neither.
        groups: effects that the data cannot tell apart.
        seen: effects that only one trial shows.
        same: those of `groups` that are equivalent in this model.
        unrepeatable: trials that cannot or should not be repeated, with the reason.
        worse: why adopting the claimed effects is unwise (`ruler_words.objection`), or "".
        adopted: adopted effects, whose values are parameters of the model.
        ended: whether all parameters that moved stopped at their bounds (`at_bounds`).
        flip: an input whose sign is to be flipped before anything is adopted, also one of another
            strength if parameters `ended`; "" for none.
        noise: whether the verdict names no gap: all that is left may be noise.
    """
    from grounded import places
    from grounded.effects import like_a_load

    if claims.known.no_cause:
        return (
            "Run another trial, or record a longer log, in which every input changes: runs of "
            "candidates count."
        )
    separable = [group for group in groups if group not in same]
    if groups and not separable and not (worse or ended or flip):
        own = next((name for name in groups[0] if name in claims.names), groups[0][0])
        return f"No trial helps: {told_apart(groups[0], same)}, so adopt the claimed one, {own}."
    if separable:
        made = f"A trial designed for it may tell {tied(separable[0])}."
        turns = bool(places.plane(claims.data.model))
        return " ".join([made, *distinguishing(separable[0], turns=turns)])
    if seen:
        one = seen[0]
        if one.repeats:
            return f"Run a different motion: all trials that show {one.effect} move alike."
        logs = {trial for trial, why in (unrepeatable or {}).items() if why == LOG}
        if len(one.trials) > 1 and {*one.trials} <= logs:
            return (
                "No trial is needed for this task: logs that no candidate made "
                f"({listed(one.trials)}) show {one.effect}, and runs of candidates hardly do."
            )
        why = (unrepeatable or {}).get(one.trial)
        if why is None:
            return f"Repeat trial {one.trial}: few others show {one.effect}."
        better = "run a gentler one" if why == LOST else "record another one"
        if one.region and one.region.of_time:
            begin, end = number(one.start), number(one.end)
            better += f" that moves as {one.trial} does from {begin} to {end} s"
        elif one.region:
            better += f" that goes {one.region.phrase}"
        return f"Trial {one.trial} shows {one.effect} best, but it {why}: {better}."
    if not claims.names and look:
        return look
    if not claims.names and not claims.blamed:
        if adopted:  # in the diagnosis that they are from, some may have tied with others
            return "No trial is needed: nothing more is found beside what was adopted."
        return "No trial is needed: nothing is found, so nothing is tied or to be adopted."
    if worse:
        return f"Adopt nothing yet: {worse}. To settle that, run another trial and diagnose again."
    if len(claims.names) > 1 and like_a_load(claims.data.model, claims.names):
        return "No trial is needed yet: give the model a parameter for a load and diagnose again."
    if ended:
        return AS_A_RATIO.format(flip=flip) if flip else AT_BOUNDS
    if flip:
        return f"No trial is needed yet: flip the sign of {flip}, as said, and diagnose again."
    fit = _own_numbers(claims, adopted)
    do = "fit the model's parameters" if fit else "adopt the claimed effects"
    said = f"No trial is needed to tell causes apart: {do}"
    if not look:
        return f"{said}."
    look = f"{look[:1].lower()}{look[1:]}"
    if noise:
        return f"{said}. Not needed, but useful: {look}"
    return f"{said} and diagnose again. If the gap is still there: {look}"


def at_bounds(claims: Claims) -> bool:
    """Check whether parameters are off and all of them stopped at a bound."""
    known = claims.parameters()
    return all_at_bounds(
        claims.data.model.params, {n: known[n].value for n in parameters_off(claims)}
    )


def _own_numbers(claims: Claims, adopted: Collection[str]) -> bool:
    """Check whether only parameters are blamed, in a model without adopted effects.

    Values that were found beside adopted effects are adopted as they are: a diagnosis is more
    careful with what effects and parameters have in common than a fit.
    """
    from grounded.effects import ParamFamily

    effects = claims.best.hypothesis.effects
    own = all(isinstance(e.family, ParamFamily) for e in effects)
    return not adopted and (own or not claims.names)


HINTS = {
    "dead_zone": "sweep it slowly through zero and hold small commands",
    "stall": "sweep it slowly through zero and hold small commands",
    "stiction": "start and stop often, from small commands",
    "coulomb_friction": "coast down from different speeds",
    "viscous_friction": "hold several speeds, slow and fast",
    "quadratic_drag": "hold several speeds, slow and fast",
    "delay": "step the input sharply, by different amounts",
    "first_order_lag": "step the input sharply, by different amounts",
    "rate_limit": "step the input by small and large amounts",
    "slew_limit": "step the input by small and large amounts",
    "input_bias": "use small and large commands, of both signs where it takes them",
    "input_gain": "use small and large commands",
    "input_fade": "repeat the same manoeuvre early and late in one trial",
    "understeer": "drive the same curve slowly and fast",
    "rate_gain": "drive the same curve slowly and fast",
    "sensor_bias": "start from different headings and reverse direction",
    "patch": "cross the same places at other speeds and directions",
    "slope": "drive the same way in several headings",
}

STRAIGHT = {  # where nothing has a heading or drives a curve
    "sensor_bias": "hold still before and after the run, and move both ways",
    "rate_gain": "make the same motion slowly and fast",
}


def distinguishing(group: Sequence[str], *, turns: bool = True) -> list[str]:
    """Return sentences on how to excite the robot so that a trial tells a group apart.

    Args:
        group: names of effects.
        turns: whether the model has a heading.
    """
    found = []
    for name in group:
        family, _, target = name.partition(":")
        hint = STRAIGHT.get(family) if not turns else None
        hint = hint or HINTS.get(family)
        text = f"{hint[0].upper()}{hint[1:]} ({target})." if hint else ""
        if text and text not in found:
            found.append(text)
    return found or ["Excite every input over its whole range."]
