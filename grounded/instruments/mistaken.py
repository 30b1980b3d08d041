"""Mistakes of a log that only the model can tell: exchanged commands, percent, a turned sensor.

Positions and velocities are held against one another without any physics (`swapped`,
`other_units`). Commands can't be: the log of a robot whose wheels are exchanged is as good as any,
it only turns the other way. So the model predicts each trial as it is logged and with the log
changed, and both times what a plain calibration can do is done (`short_runs`): a model that is
merely crude gains nothing by the change, a mistaken log gains most of what its commands do. The
same tells two joints that are exchanged with their velocities, which agree with each other, and a
sensor that counts the other way than the model.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from grounded.effects import places
from grounded.frozen import Array
from grounded.instruments.finding import DEGREES, Finding
from grounded.instruments.inputs import OVER
from grounded.instruments.kinematics import integrals
from grounded.instruments.other_units import unusable
from grounded.instruments.short_runs import Ahead, Fit
from grounded.model import Model
from grounded.result import listed, with_unit
from grounded.trial import Trial

CLEAR = 1.0  # [nats] by which a change must lower the errors of a trial
HALF = 0.5  # of the error of one state at least
PART = 0.7  # the same, of a turned sensor: a wrong sign is off by twice what the right one explains
HINT = 0.5  # [nats], of the model as it is: less is not looked into
LIKE = 4.0  # times what the model says, or a part of it: what gain an exchanged input may have
SEEN = 0.5  # [nats] by which commands in their own unit must do better than none
ODD_FROM = 5.0  # [s] of log, from which two inputs may be exchanged and one turned, too
STARTS, FEWER = 120, 40  # samples of a trial, and where many changes are asked about
TRIALS = 4  # that are asked
MANY = 8  # changes
MOST = 10  # states of which all mirror images are tried
PARTS = {"%": (0.01, "parts of 1"), "deg": (1 / DEGREES, "rad"), "deg/s": (1 / DEGREES, "rad/s")}
WHOLE = {100.0: "percent", 255.0: "counts of 8 bits", 1000.0: "thousandths"}  # full scale
OPENED = 0.05  # of full scale: the least that the largest command of a log reaches (at most OVER)
ANGULAR, LENGTHS = ("rad", "rad/s"), ("m", "m/s")


@dataclass(frozen=True)
class Mistake:
    """What may be wrong with a log.

    Args:
        states: pairs of states, each in the other's column.
        turned: states that are logged with the other sign, a position with its velocity.
        inputs: two that are, or all that are in another unit.
        factor: how many times too large these are, below 1 too small; 1 for an exchange.
        unit: what that is, in words.
        signs: of exchanged inputs, once they are back.
    """

    states: tuple[tuple[int, int], ...] = ()
    turned: tuple[int, ...] = ()
    inputs: tuple[int, ...] = ()
    factor: float = 1.0
    unit: str = ""
    signs: tuple[float, ...] = ()

    @property
    def swap(self) -> bool:
        """Two columns in each other's place, or of the other sign: no other unit."""
        return self.factor == 1.0

    def mended(self, trial: Trial) -> Trial:
        """The trial without it, but for signs."""
        x, u = np.array(trial.states), np.array(trial.inputs)
        for pair in self.states:
            x[:, pair] = x[:, pair[::-1]]
        x[:, self.turned] *= -1
        if self.swap:
            u[:, self.inputs] = u[:, self.inputs[::-1]]
        else:
            u[:, self.inputs] /= self.factor
        return replace(trial, states=x, inputs=u)


@dataclass(frozen=True)
class Told:
    """A mistake, what it makes of a state's error, and others that mend as much.

    Args:
        mistake: the likeliest.
        state: the one that the model then predicts better by most.
        logged: its rms error a quarter of a second ahead with the log as it is, in its unit.
        mended: the same without the mistake.
        others: that nothing tells from it.
    """

    mistake: Mistake
    state: int
    logged: float
    mended: float
    others: tuple[Mistake, ...] = ()


def mistaken(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> Told | None:
    """The mistake of all logs that some trials show and none contradicts.

    Args:
        model: however crude.
        trials: of its states and inputs.
        shown: states that a sensor has.
    """
    changes = [*_exchanges(model, shown), *_turned(model, shown), *_units(model, trials)]
    some = range(0, len(trials), max(1, -(-len(trials) // TRIALS)))
    starts = STARTS if len(changes) < MANY else FEWER
    found: dict[Mistake, dict[int, tuple[Fit, Fit]]] = {}
    sound: dict[Mistake, set[int]] = {}
    with np.errstate(all="ignore"):
        for k in some:
            for change, fits in _each(model, trials[k], shown, changes, starts):
                if fits is None:
                    sound.setdefault(change, set()).add(k)
                else:
                    told = replace(change, signs=_signs(change, fits[1]))
                    found.setdefault(told, {})[k] = fits
    whole = {c: fits for c, fits in found.items() if not sound.get(replace(c, signs=()))}
    if sum(trials[k].steps * trials[k].dt for k in some) < ODD_FROM:
        whole = {c: fits for c, fits in whole.items() if not any(sign < 0 for sign in c.signs)}
    return _best(whole) if whole else None


def as_logged(model: Model, told: Told, findings: Sequence[Finding]) -> Told:
    """The same without states that other instruments had turned: as they are logged they are right.

    Of a position and a velocity that disagree in sign one is turned to agree; that it was the other
    one only the model tells.
    """
    done = {f.signal for f in findings if f.kind == "sign" and f.corrected}
    left = tuple(i for i in told.mistake.turned if model.state_names[i] not in done)
    return replace(told, mistake=replace(told.mistake, turned=left)) if left else told


def judge_commands(
    model: Model,
    trials: Sequence[Trial],
    hidden: Sequence[str] = (),
    findings: Sequence[Finding] = (),
) -> None:
    """Stops at trials with commands, or joints, that the model says are mistaken.

    Args:
        model: however crude.
        trials: with what other instruments do put right, see `preflight`.
        hidden: states that no sensor has.
        findings: of the other instruments.

    Raises:
        GroundedError: with the signals and what mends them.
    """
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    told = mistaken(model, trials, shown)
    if told is not None:
        told = as_logged(model, told, findings)
        mend = mended_by(model, told)
        raise unusable(trials, range(len(trials)), described(model, told), mend)


def mended_by(model: Model, told: Told) -> str:
    """What to do about it."""
    if turned := told.mistake.turned:
        tables = listed(f"[log.state.{model.state_names[i]}]" for i in turned)
        return (
            f"Turn the sign in {tables} (scale = -1 where none is given) and in the robot's "
            "program; or in the model, if the log is right"
        )
    if told.mistake.swap:
        return "Correct the log, or the paths in [log]; or the model, if the log is right"
    tables = listed(f"[log.input.{model.input_names[j]}]" for j in told.mistake.inputs)
    by = f"{1 / told.mistake.factor:.6g}"
    limits = "as well" if told.mistake.factor > 1 else "if they were read from the log"
    return f"Multiply the scale in {tables} by {by} (1 where none is given), and [limits] {limits}"


def described(model: Model, told: Told) -> str:
    """What is wrong and how it is known, one clause."""
    unit = model.states[model.state_names[told.state]]
    error = with_unit(f"{told.mended:.2g} rather than {told.logged:.2g}", unit)
    proof = f"misses {model.state_names[told.state]} by {error} 0.25 s ahead"
    if not told.mistake.swap:
        names = listed(model.input_names[j] for j in told.mistake.inputs)
        one = len(told.mistake.inputs) == 1
        factor, large = told.mistake.factor, told.mistake.factor > 1
        times = f"{factor if large else 1 / factor:.4g}"
        return (
            f"{names} look{'s' * one} {times} times too {'large' if large else 'small'} "
            f"(in {told.mistake.unit}?): {'divided by that' if large else f'times {times}'} "
            f"the model {proof}"
        )
    said, *others = (_named(model, one) for one in (told.mistake, *told.others))
    text = said + "".join(f" (or {other})" for other in others)
    text = f"{text}: only the other way round does the model predict what the robot does ({proof})"
    mirror = _mirrored(model, told.mistake)
    if mirror:
        names = ", ".join(mirror[:-1]) + " and " * (len(mirror) > 1) + mirror[-1]
        text += f"; {names} of the other sign would do the same"
    return text


def _named(model: Model, mistake: Mistake) -> str:
    if turned := mistake.turned:
        some = listed(model.state_names[i] for i in turned)
        return f"{some} look{'s' * (len(turned) == 1)} turned, logged with the other sign"
    if mistake.inputs:
        a, b = (model.input_names[j] for j in mistake.inputs)
        signed = zip(mistake.inputs, mistake.signs, strict=True)
        odd = [model.input_names[j] for j, sign in signed if sign < 0]
        said = f"{a} and {b}" + f", with the sign of {listed(odd)}," * bool(odd)
    else:
        said = ", ".join(listed(model.state_names[i] for i in pair) for pair in mistake.states)
    return f"the columns of {said} look exchanged"


def _exchanges(model: Model, shown: Sequence[int]) -> Iterator[Mistake]:
    """Pairs of inputs, and of positions with their velocities; in unlike units, too.

    A Twist's commands are in m/s and rad/s; a log whose trolley and whose load are exchanged has
    each position with its own velocity, and no name that says what they measure.
    """
    for pair in combinations(range(model.m), 2):
        yield Mistake(inputs=pair)
    exact = [r for r in integrals(model) if r.exact and {r.i, r.j} <= set(shown)]
    for a, b in combinations(exact, 2):
        if np.isclose(a.c, b.c):
            yield Mistake(states=((a.i, b.i), (a.j, b.j)))


def _turned(model: Model, shown: Sequence[int]) -> Iterator[Mistake]:
    """Each state with the one that it is the rate of, or whose rate it is: a sensor turns both."""
    pairs = [(r.i, r.j) for r in integrals(model) if r.exact and {r.i, r.j} <= set(shown)]
    alone = [(i,) for i in shown if not any(i in pair for pair in pairs)]
    for group in sorted((*pairs, *alone)):
        yield Mistake(turned=group)


def _units(model: Model, trials: Sequence[Trial]) -> Iterator[Mistake]:
    """Other units of all inputs of one unit; of a pure number by the largest that was sent."""
    if not trials:
        return
    units = list(model.inputs.values())
    for unit in dict.fromkeys(units):
        same = tuple(j for j, one in enumerate(units) if one == unit)
        if unit in ANGULAR:
            yield Mistake(inputs=same, factor=DEGREES, unit="degrees")
        elif unit in PARTS:
            factor, other = PARTS[unit]
            if max(float(np.abs(t.inputs[:, same]).max(initial=0.0)) for t in trials) < OVER:
                yield Mistake(inputs=same, factor=factor, unit=other)
        elif unit != "1":
            yield Mistake(inputs=same, factor=1000.0, unit=f"thousandths of {unit}")
            if unit in LENGTHS:
                yield Mistake(inputs=same, factor=100.0, unit=f"c{unit}")
        else:
            most = max(float(np.abs(t.inputs[:, same]).max(initial=0.0)) for t in trials)
            full = next((f for f in WHOLE if OPENED * f < most < OVER * f), None)
            if full is not None:
                yield Mistake(inputs=same, factor=full, unit=WHOLE[full])


def _each(
    model: Model,
    trial: Trial,
    shown: Sequence[int],
    changes: Sequence[Mistake],
    starts: int,
) -> Iterator[tuple[Mistake, tuple[Fit, Fit] | None]]:
    """Of each change that a trial tells of: the fits as logged and mended; None where as logged."""
    known = [i for i in shown if np.isfinite(trial.states[:, i]).any()]
    logged = Ahead(model, trial, known, starts)
    if not logged.enough or not np.isfinite(trial.inputs).all():
        return
    plain = logged.plain(np.ones(model.m)).score
    for change in changes:
        mended = Ahead(model, change.mended(trial), known, starts)
        if not mended.enough:
            continue
        gain = plain - min(mended.plain(gains).score for gains in _signed(model, change))
        if gain < -HINT:
            yield change, None
        elif gain > HINT:
            fits = _compared(model, logged, mended, change)
            yield change, fits


def _compared(
    model: Model, logged: Ahead, mended: Ahead, change: Mistake
) -> tuple[Fit, Fit] | None:
    """Both calibrated; None where the change is not clearly better then."""
    signed, still = _signed(model, change), mended.still().score
    after = mended.best([min(signed, key=lambda gains: mended.plain(gains).score)])
    if not _plausible(change, after) or after.score > still - (CLEAR if change.swap else SEEN):
        return None
    before = logged.best(signed[:1], free=False)
    if not change.swap:
        after = mended.best(signed[:1], free=False)
        seen = change.factor < 1 or before.score > still + CLEAR  # too small, they do nothing
        return (before, after) if seen and _better(change, before, after) else None
    if _better(change, before, after):
        before = logged.best([*signed, *_odd_signs(model, change), np.zeros(model.m)])
    return (before, after) if _better(change, before, after) else None


def _better(change: Mistake, before: Fit, after: Fit) -> bool:
    part = PART if change.turned else HALF
    return before.score - after.score > CLEAR and bool((after.rms < part * before.rms).any())


def _plausible(change: Mistake, fit: Fit) -> bool:
    """Whether inputs do about what the model says, once the log is mended; a sign may be odd."""
    gains = fit.gains[list(change.inputs)]
    sized = (np.abs(gains) > 1 / LIKE) & (np.abs(gains) < LIKE)
    positive = (gains > 0).any() if change.swap else (gains > 0).all()
    return bool(np.all(sized)) and (not len(gains) or bool(positive))


def _signs(change: Mistake, fit: Fit) -> tuple[float, ...]:
    return tuple(float(np.sign(fit.gains[j])) for j in change.inputs) if change.swap else ()


def _signed(model: Model, change: Mistake) -> list[Array]:
    """Gains to begin with: as the model has them, and one of two exchanged inputs turned round."""
    found = [np.ones(model.m)]
    for j in change.inputs if change.swap else ():
        found.append(np.where(np.arange(model.m) == j, -1.0, 1.0))
    return found


def _odd_signs(model: Model, change: Mistake) -> list[Array]:
    """Signs of the inputs with which a log may be explained as it is: all turned, or one."""
    if not (change.inputs or change.turned):
        return []
    one = [np.where(np.arange(model.m) == j, -1.0, 1.0) for j in range(model.m)]
    return [-np.ones(model.m), *(one if change.turned and model.m > 1 else ())]


def _best(found: Mapping[Mistake, Mapping[int, tuple[Fit, Fit]]]) -> Told:
    """The change that leaves least, with those that leave nearly as little.

    Of these an exchange comes first: it is one mistake of [log], where a sensor that counts the
    other way than the model says has the robot's program wrong as well.
    """
    most = max(len(fits) for fits in found.values())
    left = {
        change: float(np.mean([after.score for _, after in fits.values()]))
        for change, fits in found.items()
        if len(fits) == most
    }
    least = min(left, key=lambda change: left[change])
    near = [c for c in left if c == least or (c.swap and left[c] < left[least] + CLEAR)]
    near = near if least.swap else [least]
    first, *others = sorted(near, key=lambda change: (change.turned != (), left[change]))
    before, after = next(iter(found[first].values()))
    i = int(np.argmin(after.rms / before.rms))
    return Told(first, i, float(before.rms[i]), float(after.rms[i]), tuple(others))


def _mirrored(model: Model, mistake: Mistake) -> tuple[str, ...]:
    """States whose other sign is the same to the model as two exchanged inputs; () for none."""
    if not mistake.inputs or model.n > MOST or min(mistake.signs, default=1.0) < 0:
        return ()
    (x, u), dt = places.samples(model, 8), places.probe(model, 0.01)
    other = np.array(u)
    other[:, mistake.inputs] = other[:, mistake.inputs[::-1]]
    for signs in sorted(product((1.0, -1.0), repeat=model.n), key=lambda s: -sum(s)):
        mirror = np.array(signs)
        moved = mirror * (model.system.step(mirror * x, u, model.values, dt) - mirror * x)
        usual = model.system.step(x, other, model.values, dt) - x
        if np.abs(moved - usual).max() < 1e-6 * max(float(np.abs(usual).max()), 1e-300):
            return tuple(n for n, s in zip(model.state_names, signs, strict=True) if s < 0)
    return ()
