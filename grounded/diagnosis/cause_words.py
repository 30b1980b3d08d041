"""Causes in words: each effect with its values, effects of one kind in one clause."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from grounded.diagnosis.parts import Changed, Estimate, TrialValue
from grounded.model import Model
from grounded.result import (
    figure,
    listed,
    measured_alike,
    number,
    or_zero,
    percent,
    seen,
    spread,
    with_unit,
)

if TYPE_CHECKING:  # whoever reads a verdict needs none of what makes it
    from grounded.diagnosis.error_report import Credit
    from grounded.effects import Effect

AS_STRONG = 0.2  # a gain this close to -1 is a wrong sign and nothing else
TURNED = (
    ": flip its sign in model.py, or, if only the log has it so, multiply the scale in {log} by -1 "
    "(a missing one is 1), and {limits} if they were taken from the log, discard the trials and "
    "ingest their logs again"
)
LARGE = 1e3  # values from here on have no power of ten that a few digits would give them
MOST_DIGITS = 6  # significant digits of a value
DISAGREE = "but the trials disagree"
KNOWN = 2.0  # standard deviations from zero that a value needs to be worded
RESCALE = ("input_gain", "input_curve", "input_fade")  # they change what a volt of an input does
OWN = "the model's own parameters"
GIVEN = ", given {} as in the model"
MOST_TIMES = 1000  # a larger ratio of errors says no more
HARDLY = 1.001  # ratio of errors below which they count as the same
FEW = 3  # up to so many causes get a clause each


def give_or_take(estimate: Estimate) -> str:
    """Format a value with as many digits as its +- supports: `1.5763 +- 0.0012 N/V`."""
    value, std = estimate.value, estimate.std
    if not (0 < std < math.inf and math.isfinite(value)):
        return quantity(estimate)
    if or_zero(std, value) == 0:
        return quantity(replace(estimate, std=0.0))
    value = seen(value, std)
    places = math.floor(math.log10(max(abs(value), std))) - math.floor(math.log10(std)) + 2
    digits = min(max(places, 3), MOST_DIGITS)
    scatter = spread(std)
    shown = figure(value, digits) if abs(value) >= LARGE else f"{value:#.{digits}g}".rstrip(".")
    shown = shown if value else "0"
    return with_unit(f"{shown} +- {scatter}", estimate.unit)


GREEK = (
    "alpha|beta|gamma|delta|epsilon|zeta|eta|theta|iota|kappa|lambda|mu|nu|xi|omicron|pi|rho|sigma"
    "|tau|upsilon|phi|chi|psi|omega"
)


NOUNS = (  # names of inputs that can be the subject of a sentence
    *("acceleration", "aileron", "brake", "current", "drive", "elevator", "force", "fuel", "gas"),
    *("heater", "heating", "lift", "moment", "motor", "pedal", "power", "pressure", "pump", "push"),
    *("rudder", "servo", "speed", "steer", "steering", "throttle", "thrust", "torque", "valve"),
    *("voltage", "winch"),
)


def called(model: Model, name: str) -> str:
    """Name a state or input in a sentence: `the speed v`, `the state delta`, `the throttle`.

    Symbols (short names, Greek letters, names with digits), plurals (volts) and inputs whose name
    is no noun (left) get a noun in front.
    """
    word = _noun(model, name)
    return f"the {name}" if not word or name == word else f"the {word} {name}"


def all_called(model: Model, names: Sequence[str]) -> str:
    """Name several states or inputs in a sentence: `the inputs left and right`."""
    words = {_noun(model, name) for name in names}
    if len(names) < 2 or words not in ({"input"}, {"state"}):
        return listed(called(model, name) for name in names)
    return f"the {words.pop()}s {listed(names)}"


def _noun(model: Model, name: str) -> str:
    """Return the noun that a name needs in front of it in a sentence; "" if it needs none."""
    from grounded import places

    # one of two velocities, `vx` beside `vy`, is not the speed
    own = places.role(model, "speed") or len([u for u in model.states.values() if u == "m/s"]) == 1
    roles = {
        "speed": (places.speed(model),) if own else (),
        "heading": places.role(model, "heading"),
        "heading rate": places.role(model, "heading_rate"),
        "position": places.position(model),
        "angle": model.angles,
    }
    word = next((role for role, played in roles.items() if name in played), "")
    if not word and (
        len(name) <= 3 or re.fullmatch(GREEK, name) or not name.isalpha() or name.endswith("s")
    ):
        word = "input" if name in model.input_names else "state"
    return word or "input" * (name in model.input_names and name.lower() not in NOUNS)


def meaning(effect: Effect, params: Mapping[str, Estimate]) -> str:
    """Fill names and values into the sentence of an effect's family; starts in lower case."""
    from grounded import places
    from grounded.effects import ParamFamily
    from grounded.effects.medium import factors

    model, targets = effect.site.model, effect.site.targets
    constants = {q.name: Estimate(q.start, 0.0, None, q.unit) for q in effect.quantities if q.fixed}
    known = {**constants, **params}
    words = {name: quantity(e) for name, e in known.items()}
    words.setdefault("s", "s" if len(targets) == 1 else "")
    words |= {"has": "has", "es": "es"} if len(targets) == 1 else {"has": "have", "es": ""}
    centre = [name for name in places.position(model) if f"{name}0" in known]  # of a patch
    words["place"] = listed(f"{name} = {words[f'{name}0']}" for name in centre)
    clear = "L" in known and known["L"].value > 0
    words["least"] = f"at {words['L']}, its smallest" if clear else "near zero"
    driven, _, source = effect.site.target.partition("<-")
    words["target"] = all_called(model, targets)
    if isinstance(effect.family, ParamFamily):
        words["target"] = effect.site.target
    axes = [*model.roles.get("position", ())][:2]
    axes = axes if len(axes) == 2 else ["the first axis", "the second"]
    words |= {"axis_1": axes[0], "axis_2": axes[1]}
    inputs = [f"[log.input.{name}]" for name in targets if name in model.inputs]
    words |= {
        "log": listed(inputs),
        "limits": "[limits]",
        "driven": called(model, driven),
        "source": called(model, source),
    }
    if "{product}" in effect.family.sentence:
        words["product"] = " * ".join(factors(effect.site))

    if driven in model.inputs and len(targets) > 1:  # a wheel's: several velocities at once
        words["source"] = "its speed"

    def filled(found: re.Match[str]) -> str:
        name, percent, more, less = found.groups()
        if percent is None or name not in params:
            return words.get(name, found.group(0))
        value = 100 * effect.family.ratio(name, params[name].value)
        if more is None:
            return f"{number(value)} %"
        return f"{number(abs(value))} % {more if value >= 0 else less}"

    told = {*_told(params), *(n for n, e in constants.items() if e.value)}

    def kept(found: re.Match[str]) -> str:  # parts whose quantities are estimated and not zero
        parts = found[1].split(" & ")
        known = [p for p in parts if {*re.findall(r"\{(\w)[%}]", p)} <= told]
        return listed(known or (parts[1:] and parts[:1]))

    own = isinstance(effect.family, ParamFamily) and effect.site.target in model.params
    if own and "d" in params:
        own_param = model.params[effect.site.target]
        new = give_or_take(params["d"].moved(own_param.value))
        old = with_unit(number(own_param.value), own_param.unit)
        return f"the parameter {effect.site.target} should be {new} instead of {old}"

    if effect.known and "d" in params:
        by, now = params["d"], params["d"].moved(effect.quantities[0].known)
        more = f"{number(abs(by.value))} s {'less' if by.value < 0 else 'more'} than adopted"
        return f"the delay of {words['target']} should be {give_or_take(now)}, {more}"

    def signed(found: re.Match[str]) -> str:
        name, positive, negative = found.groups()
        less = name in params and params[name].value < 0
        if less:
            words[name] = words[name].removeprefix("-")
        return negative if less else positive

    text = re.sub(r"\[([^]]*)\]", kept, _turned(effect, params) or effect.family.sentence)
    text = re.sub(r"\{(\w+)>([^{}|]+)\|([^{}|]+)\}", signed, text)
    return re.sub(r"\{(\w+)(%)?(?:([^{}|]+)\|([^{}|]+))?\}", filled, text)


def counted(effect: Effect, acting: Sequence[Effect]) -> str:
    """Return a clause: before or after a claimed gain of its input an effect's volts are counted.

    Args:
        effect: a claimed effect.
        acting: all claimed effects, those on inputs in the order in which they act.

    Returns:
        The clause; "" for an effect without a value in its input's unit, or beside no gain.
    """
    from grounded.effects import InputFamily, LossFamily, MemoryFamily

    family, site = effect.family, effect.site
    on_input = isinstance(family, InputFamily | MemoryFamily)
    if family.name in RESCALE or not (on_input or isinstance(family, LossFamily)):
        return ""
    own = set(site.targets) if on_input else {site.target.partition("<-")[0]}
    units = {site.model.inputs[name] for name in own}
    ends = tuple(unit + end for unit in units for end in (" ", "/"))
    if not any(q.unit in units or q.unit.startswith(ends) for q in effect.free):
        return ""
    gains = [
        i for i, e in enumerate(acting) if e.family.name in RESCALE and own & {*e.site.targets}
    ]
    if not gains:
        return ""
    at = [e.name for e in acting].index(effect.name) if on_input else len(acting)
    gain = "its gain" if len(own) == 1 else "their gains"
    if gains[0] < at < gains[-1]:
        return f", counted between the changes of {gain}"
    return f", counted {'before' if at < gains[0] else 'after'} the change of {gain}"


def at_middle(
    effect: Effect, acting: Sequence[Effect], values: Mapping[str, Mapping[str, Estimate]]
) -> str:
    """Return the command to which a claimed gain belongs, beside a curve of its input; else "".

    The factor of `input_curve` is 1 at (L + U) / 2: elsewhere both change the gain.

    Args:
        effect: a claimed effect.
        acting: all claimed effects.
        values: the estimates of each effect, by name.
    """
    own, of_curve = {*effect.site.targets}, "input_curve"
    curves = (e for e in acting if e.family.name == of_curve and own <= {*e.site.targets})
    curve = next(curves, None) if effect.family.name == "input_gain" else None
    if curve is None or "b" not in _told(values[curve.name]):
        return ""
    ends = {q.name: q for q in curve.quantities if q.fixed}
    low, high = ends["L"], ends["U"]
    middle = with_unit(number((low.start + high.start) / 2), high.unit)
    least = "its smallest" if low.start > 0 else "zero"
    return f" at {middle}, half way between {least} and its largest command"


def other_unit(name: str, params: Mapping[str, Estimate]) -> str:
    """Return a clause for an input's gain of about a power of ten: its log may be in another unit.

    "" for any other gain or effect.
    """
    if not name.startswith("input_gain:") or not params["g"].value > -1:
        return ""
    power = round(math.log10(1 + params["g"].value))
    if not power or abs((1 + params["g"].value) / 10.0**power - 1) > AS_STRONG:
        return ""
    ratio = f"{10.0 ** abs(power):,.0f}"
    return f" (about {ratio if power > 0 else f'1/{ratio}'}: is the log in another unit?)"


def acts_reversed(params: Mapping[str, Estimate]) -> bool:
    """Return whether the values of an effect are a gain that reverses the sign."""
    return "g" in params and params["g"].value < -1


def sign_only(name: str, params: Mapping[str, Estimate]) -> bool:
    """Return whether an effect is an input of the wrong sign and of the modelled strength.

    The verdict then says to flip the sign; a reversed input of another strength is adopted.
    """
    return (
        name.startswith("input_gain:")
        and acts_reversed(params)
        and abs(-1 - params["g"].value - 1) < AS_STRONG
    )


def _turned(effect: Effect, params: Mapping[str, Estimate]) -> str:
    """Return the sentence for a gain of the opposite sign; "" if the sign is right."""
    text = effect.family.turned
    if not (text and acts_reversed(params)):
        return ""
    if sign_only(effect.name, params):
        return text + TURNED
    size = -1 - params["g"].value
    if abs(size - 1) < AS_STRONG:
        return text
    return f"{text} (with {number(100 * size)} % of the modelled strength)"


def clauses(
    names: Sequence[str],
    causes: Sequence[str],
    credit: Sequence[Credit],
    effects: Mapping[str, Effect],
    values: Mapping[str, Mapping[str, Estimate]],
) -> tuple[str, ...]:
    """Return the clauses of the verdict's first sentence, each with its worth, largest first.

    More than FEW causes are grouped by kind: the friction of every joint in one clause.

    Args:
        names: names of the causes, largest first.
        causes: one clause per cause.
        credit: what each cause is worth.
        effects: the causes that are effects, by name.
        values: the estimates of each effect, by name.
    """
    if len(names) < 2:
        return tuple(causes)
    if len(names) <= FEW:
        return tuple(with_worth(text, [one]) for text, one in zip(causes, credit, strict=True))
    kinds: dict[tuple[str, ...], list[int]] = {}
    for i, name in enumerate(names):
        own = effects.get(name)
        alike = own is not None and not re.search(r"[%|>]", own.family.sentence)
        alike = alike and DISAGREE not in causes[names.index(name)]
        key = (own.family.name, *_told(values[name])) if own is not None and alike else (name,)
        kinds.setdefault(key, []).append(i)
    groups = sorted(kinds.values(), key=lambda group: -sum(credit[i].share for i in group))
    found = []
    for first, *others in groups:
        same = [f", {_beside(effects[names[i]], values[names[i]])}" for i in others]
        together = [credit[i] for i in (first, *others)]
        found.append(with_worth(f"{causes[first]}{''.join(same)}", together))
    return tuple(found)


ORDER = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth")


def with_worth(clause: str, credit: Sequence[Credit]) -> str:
    """Append to a clause on one or more causes how much larger errors are without them."""
    if any(math.isnan(one.times) for one in credit):  # a document of an older version
        return clause
    sizes = [as_large(one.times) for one in credit]
    if len(sizes) == 1:
        return f"{clause} (without this, errors are {sizes[0]})"
    if len({*sizes}) == 1:
        return f"{clause} (without one of these, errors are {sizes[0]})"
    each = [f"{size} without the {nth}" for nth, size in zip(ORDER, sizes, strict=False)]
    return f"{clause} (errors are {listed(each)})"


def as_large(times: float) -> str:
    """Return `7 % larger`, or `2.4 times as large` from a factor of 2 on."""
    if times < HARDLY:
        return "hardly larger"
    return f"{percent(times - 1)} larger" if times < 2 else f"{times_of(times)} as large"


def times_of(times: float) -> str:
    """Return `2.4 times` for a factor, in two significant digits."""
    if times > MOST_TIMES:
        return f"over {MOST_TIMES:,} times"
    return f"{times:.1f} times" if times < 9.95 else f"{float(f'{times:.2g}'):,g} times"


def disagreement(values: Sequence[TrialValue], unit: str) -> str:
    """Return a clause on a value that the trials disagree on, with the two that differ most."""
    low, high = furthest_apart(values)
    ends = [with_unit(number(one.value), unit) for one in (low, high)]
    if low.value >= 0 and any("e-" in end for end in ends):
        ends = measured_alike([low.value, high.value], unit)
    return f"{DISAGREE}: {low.quantity} = {' to '.join(ends)}"


def furthest_apart(values: Sequence[TrialValue]) -> tuple[TrialValue, TrialValue]:
    """Return the two values that differ by most standard deviations, the smaller one first.

    The extremes are often values that a trial hardly determines, and prove nothing.
    """

    def apart(pair: tuple[TrialValue, TrialValue]) -> float:
        std = math.hypot(pair[0].std, pair[1].std)
        return abs(pair[1].value - pair[0].value) / std if std > 0 else 0.0

    low, high = max(itertools.combinations(values, 2), key=apart)
    return (low, high) if low.value <= high.value else (high, low)


def comparison(changed: Iterable[Changed], adopted: Iterable[str]) -> str:
    """Return a sentence on what changed between two groups of trials, or that nothing did.

    Args:
        changed: the values that differ.
        adopted: names of adopted effects, whose values are parameters of the model.
    """
    adopted = tuple(adopted)
    told = [
        f"{value_of(one, adopted)} changed from {give_or_take(one.first)} to "
        f"{give_or_take(one.second)}"
        for one in changed
    ]
    if not told:
        return "Nothing that these trials show changed between the two groups beyond the noise."
    return f"Between the two groups, {listed(told)}."


def value_of(one: Changed, adopted: Iterable[str]) -> str:
    """Name a compared value: `r`, `c of dead_zone:u`, also if an adopted effect has it."""
    if not one.effect.startswith("parameter:"):
        return f"{one.quantity} of {one.effect}"
    return value_called(one.quantity, adopted)


def value_called(name: str, adopted: Iterable[str]) -> str:
    """Name a parameter of the model: `r`, or `d of delay:u` if it is an adopted effect's."""
    from grounded.effects import param_name

    effect = effect_of(name, adopted)
    return f"{name.removeprefix(param_name(effect, ''))} of {effect}" if effect else name


def effect_of(name: str, adopted: Iterable[str]) -> str:
    """Return the adopted effect that a parameter belongs to; "" if it is the model's own."""
    from grounded.effects import param_name

    of = [effect for effect in adopted if name.startswith(param_name(effect, ""))]
    return max(of, key=len, default="")


def ended(estimate: Estimate, before: float) -> tuple[str, ...]:
    """Return what is said of a parameter that stopped: nothing, or one clause.

    Args:
        estimate: its calibrated value.
        before: its value in the model.
    """
    where = {"bound": "at its bound", "prior": "at the limit of its std"}.get(estimate.stopped)
    way = "less" if estimate.value < before else "more"
    return (f"{where}, the data ask for {way}",) if where else ()


def wider(known: Mapping[str, Estimate]) -> str:
    """Return advice on the parameters that their prior stopped; "" if there are none.

    Args:
        known: the calibrated values, by parameter.
    """
    names = [name for name, estimate in known.items() if estimate.stopped == "prior"]
    if not names:
        return ""
    one = len(names) == 1
    its, each = ("its", "it is") if one else ("their", "they are")
    return (
        f"{listed(names)} moved as far as {its} std allows, and the data ask to go further: if "
        f"{each} known less well than that, widen {its} std in the model file, or give bounds "
        "instead, and diagnose again; otherwise adopt the claimed effects."
    )


def _beside(effect: Effect, params: Mapping[str, Estimate]) -> str:
    """Return what an effect adds to the clause of another of its family: `the base 0.45 N m`."""
    driven, _, source = effect.site.target.partition("<-")
    targets = [driven] if source else effect.site.targets
    who = all_called(effect.site.model, targets)
    told = [params[name] for name in _told(params)] or list(params.values())
    return f"{who} {listed(map(quantity, told))}"


def _told(params: Mapping[str, Estimate]) -> list[str]:
    """Return the quantities that differ from zero by more than 2 standard deviations."""
    return [n for n, e in params.items() if e.value != 0 and not abs(e.value) <= KNOWN * e.std]


def quantity(estimate: Estimate) -> str:
    """Format a value with its unit."""
    return with_unit(number(estimate.value), estimate.unit)
