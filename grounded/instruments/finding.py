"""Finding: one thing that an instrument does, in the units in which a person would mend it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

from grounded.result import Document

DEGREES = 57.29577951308232  # in a radian
RPM = 9.549296585513721  # turns a minute in a radian a second
ALIKE = 0.02  # of a factor, to be taken for a unit's


@dataclass(frozen=True, eq=False)
class Finding(Document):
    """What was found of one signal, and whether the trials were corrected for it.

    Args:
        signal: a state or an input, or several joined by "+".
        finding: one clause.
        kind: delay, lag, smoothed, scale, sign, degrees, wrapped, offset, stuck, held, dropout,
            missing, quantised, saturated, beyond (its limits), constant, copy or mismatch (with
            others).
        delay_s: how late the signal is [s].
        std_s: standard deviation of that.
        scale: what the signal shows, over what it should.
        share: of the samples that are concerned, 0 to 1.
        corrected: the physics was judged on corrected trials.
        log: key and value for the signal's [log] table that correct it in the logs too.
        advice: what to change instead where no [log] reads the trials.
    """

    signal: str
    finding: str
    kind: str = ""
    delay_s: float = 0.0
    std_s: float = field(default=float("nan"), metadata={"brief": True})
    scale: float = 1.0
    share: float = field(default=float("nan"), metadata={"brief": True})
    corrected: bool = False
    log: str = field(default="", metadata={"brief": True})
    advice: str = field(default="", metadata={"brief": True})


def put_right(
    name: str,
    text: str,
    kind: str,
    log: str,
    *,
    delay_s: float = 0.0,
    std_s: float = float("nan"),
    scale: float = 1.0,
) -> Finding:
    """A finding that the trials were corrected for."""
    return Finding(name, text, kind, delay_s, std_s, scale, corrected=True, log=log)


def filters_of(findings: Iterable[Finding]) -> dict[str, float]:
    """Time constants of the sensors that filter and were corrected for, by state [s]."""
    return {f.signal: f.delay_s for f in findings if f.corrected and f.kind == "lag"}


def in_the_log(findings: Iterable[Finding]) -> list[Finding]:
    """Those of columns that are in degrees, or turned: put right here, and nowhere else."""
    return [one for one in findings if one.corrected and one.kind in ("degrees", "sign")]


def late_effects(findings: Iterable[Finding]) -> dict[str, dict[str, float]]:
    """The filters and delays of sensors that were found and corrected, as effects by name.

    The physics was judged without them; a controller feeds back what comes through them.
    """
    found = {}
    for one in findings:
        if one.corrected and one.kind == "lag" and one.delay_s > 0 and not one.log:
            found[f"sensor_lag:{one.signal}"] = {"tau": one.delay_s}
        elif one.corrected and one.kind == "delay" and one.delay_s > 0:
            found[f"sensor_delay:{one.signal}"] = {"d": one.delay_s}
    return found


def a_mean(name: str, position: str, over: float) -> Finding:
    """A finding of a velocity that was left out: its position's difference over a time [s]."""
    text = f"shows a mean over {over:.2g} s, as a difference of {position} does; left out here: "
    return Finding(name, f"{text}{position} says as much", "smoothed", corrected=True)


def in_degrees(name: str, unit: str) -> Finding:
    """A finding of a signal that was put into radians."""
    text, log = f"is in degrees, not in {unit}", f"scale = {1 / DEGREES:.8g}"
    return put_right(name, text, "degrees", log, scale=DEGREES)


def scaled(name: str, position: str, size: float, unit: str) -> Finding:
    """A finding of a velocity that shows `size` times the rate of its position."""
    text = f"shows {100 * size:.3g} % of the rate of {position}"
    if unit == "rad/s" and abs(size / RPM - 1) < ALIKE:
        mend = f"if so, [log] scale = {1 / RPM:.8g}"
        text = f"{text}, 60 / (2 pi) times it: it looks to be in rpm; {mend}"
    elif unit == "rad/s" and abs(size * RPM - 1) < ALIKE:
        text = f"{text}, 2 pi / 60 times it: it looks to have been taken for rpm, and converted"
    else:
        text = f"{text}; either may be wrong"
    return Finding(name, text, "scale", scale=size)
