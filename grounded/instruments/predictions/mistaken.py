"""Log faults that only the model reveals: exchanged commands, commands in percent, sensor signs.

Positions and velocities are compared without any physics (`swapped`, `other_units`). Commands can't
be: if a robot's two wheel commands are exchanged, its log is consistent, and the robot just turns
the other way. The model therefore predicts each trial with the log as it is and with the log
changed, calibrated in both cases (`short_runs`). If the model is only crude, the change does not
help; if the log is wrong, the change explains most of what the commands do. The same method finds
two joints that are exchanged together with their velocities, and sensors whose sign is opposite to
the model's.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from grounded import places
from grounded.frozen import Array
from grounded.instruments.finding import DEGREES, Finding, unusable
from grounded.instruments.inputs import OVER
from grounded.instruments.predictions.input_signs import act_on_each
from grounded.instruments.predictions.short_runs import Ahead, Fit
from grounded.model import Model
from grounded.places import integrals
from grounded.result import listed, with_unit
from grounded.trial import Trial

CLEAR = 1.0  # [nats] by which a change must lower the errors of a trial
HALF = 0.5  # the error of at least one state must fall to this share
PART = 0.7  # the same for a sensor's sign: a wrong sign doubles what the right one explains
HINT = 0.5  # [nats] of the uncalibrated model: smaller changes are not examined
LIKE = 4.0  # the gain of an exchanged input must be within this factor of the model's
SEEN = 0.5  # [nats] by which commands in their unit must do better than no commands
ODD_FROM = 5.0  # [s] of log needed to find two inputs exchanged and one with the wrong sign
STARTS, FEWER = 120, 40  # samples of a trial to predict from; the latter with many changes
TRIALS = 4  # trials examined
MANY = 8  # number of changes from which on FEWER is used
MOST = 10  # largest number of states for which all mirror images are tried
PARTS = {"%": (0.01, "parts of 1"), "deg": (1 / DEGREES, "rad"), "deg/s": (1 / DEGREES, "rad/s")}
WHOLE = {100.0: "percent", 255.0: "counts of 8 bits", 1000.0: "thousandths"}  # full scale
OPENED = 0.05  # of full scale: least value of the largest command in a log (at most OVER)
SWAP_BACK = "Correct the paths in [log] (or the model, if the log is right)"
ANGULAR, LENGTHS = ("rad", "rad/s"), ("m", "m/s")


@dataclass(frozen=True)
class Mistake:
    """A possible fault of a log.

    Args:
        states: pairs of exchanged states.
        turned: states logged with the opposite sign, a position together with its velocity.
        inputs: two exchanged inputs, or all inputs in another unit.
        factor: how many times too large the inputs are, below 1 too small; 1 for an exchange.
        unit: the unit that the inputs seem to be in, in words.
        signs: of exchanged inputs after the exchange is undone.
    """

    states: tuple[tuple[int, int], ...] = ()
    turned: tuple[int, ...] = ()
    inputs: tuple[int, ...] = ()
    factor: float = 1.0
    unit: str = ""
    signs: tuple[float, ...] = ()

    @property
    def swap(self) -> bool:
        """Whether it is an exchange or a sign, rather than another unit."""
        return self.factor == 1.0

    def mended(self, trial: Trial) -> Trial:
        """Return the trial without this fault; `signs` are not undone."""
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
    """The likeliest fault of a log, the evidence, and other faults that explain it as well.

    Args:
        mistake: the likeliest fault.
        state: the state whose prediction improves most without the fault.
        logged: its rms error a quarter of a second ahead with the log as it is, in its unit.
        mended: the same without the fault.
        others: faults that the data can't distinguish from it.
    """

    mistake: Mistake
    state: int
    logged: float
    mended: float
    others: tuple[Mistake, ...] = ()


def mistaken(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> Told | None:
    """Return the fault that some trials show and none contradicts; None if there is none.

    Args:
        model: however crude.
        trials: of its states and inputs.
        shown: indices of the states with a sensor.
    """
    changes = [*_exchanges(model, shown), *_turned(model, shown), *other_input_units(model, trials)]
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
    if not whole:
        return None
    best = _best(whole)
    return _most_telling(model, trials[min(whole[best.mistake])], shown, best)


def _most_telling(model: Model, trial: Trial, shown: Sequence[int], told: Told) -> Told:
    """Return an exchange with the state of the strongest evidence, with the model as it is.

    Calibrated to a log with two exchanged wheels, a model turns the robot with neither: its heading
    rate, which shows the exchange best, is then hardly worse than its speed.
    """
    if not told.mistake.inputs or not told.mistake.swap:
        return told
    known = [i for i in shown if np.isfinite(trial.states[:, i]).any()]
    signs = np.ones(model.m)
    signs[list(told.mistake.inputs)] = told.mistake.signs or 1.0
    with np.errstate(all="ignore"):
        before = Ahead(model, trial, known, STARTS).plain(np.ones(model.m))
        after = Ahead(model, told.mistake.mended(trial), known, STARTS).plain(signs)
    i = int(np.argmin(after.rms / before.rms))
    if not after.rms[i] / before.rms[i] < told.mended / told.logged:
        return told
    return replace(told, state=i, logged=float(before.rms[i]), mended=float(after.rms[i]))


def contradicted(model: Model, trial: Trial, shown: Sequence[int], change: Mistake) -> bool:
    """Check whether the model predicts a trial clearly better as logged than without a fault.

    Args:
        model: however crude.
        trial: of its states and inputs.
        shown: indices of the states with a sensor.
        change: the fault, of another trial.
    """
    known = [i for i in shown if np.isfinite(trial.states[:, i]).any()]
    logged, mended = (Ahead(model, one, known, STARTS) for one in (trial, change.mended(trial)))
    if not (logged.enough and mended.enough) or not np.isfinite(trial.inputs).all():
        return False
    with np.errstate(all="ignore"):
        return _gained(model, logged.plain(np.ones(model.m)).score, mended, change) < -HINT


def as_logged(model: Model, told: Told, findings: Sequence[Finding]) -> Told:
    """Remove the states whose sign other checks had already reversed: the log has them right.

    If a position and a velocity disagree in sign, one of them is reversed to agree. Only the model
    shows that it was the other one.
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
    """Raise an error if the model shows that commands or joints in the logs are wrong.

    Args:
        model: however crude.
        trials: already corrected for other faults, see `preflight`.
        hidden: states without a sensor.
        findings: of the other checks.

    Raises:
        GroundedError: naming the signals and the correction.
    """
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    told = mistaken(model, trials, shown)
    if told is not None:
        told = as_logged(model, told, findings)
        mend = mended_by(model, told)
        raise unusable(trials, range(len(trials)), described(model, told), mend)


def mended_by(model: Model, told: Told) -> str:
    """Return the instruction that corrects the fault."""
    if turned := told.mistake.turned:
        tables = listed(f"[log.state.{model.state_names[i]}]" for i in turned)
        return (
            f"Reverse the sign in {tables} (scale = -1 if it has none) and in the robot's "
            "program; or in the model, if the log is right"
        )
    if told.mistake.swap:
        return SWAP_BACK
    tables = listed(f"[log.input.{model.input_names[j]}]" for j in told.mistake.inputs)
    by = f"{1 / told.mistake.factor:.6g}"
    return (
        f"Multiply the scale in {tables} by {by} (a missing scale is 1), and [limits] if they were "
        "taken from the log"
    )


def described(model: Model, told: Told, *, robot: bool = False) -> str:
    """Return one clause: what is wrong, and the evidence.

    Args:
        model: with the names and units.
        told: the fault.
        robot: an exchange is the robot's, and the log is right.
    """
    unit = model.states[model.state_names[told.state]]
    error = with_unit(f"{told.mended:.2g} instead of {told.logged:.2g}", unit)
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
    named = _swapped if robot else _named
    said, *others = (named(model, one) for one in (told.mistake, *told.others))
    text = said + "".join(f" (or {other})" for other in others)
    text = f"{text}: only with that undone does the model predict the robot's motion ({proof})"
    mirror = _mirrored(model, told.mistake)
    if mirror:
        names = ", ".join(mirror[:-1]) + " and " * (len(mirror) > 1) + mirror[-1]
        text += f"; the opposite sign of {names} would have the same effect"
    return text


def _named(model: Model, mistake: Mistake) -> str:
    if turned := mistake.turned:
        some = listed(model.state_names[i] for i in turned)
        return f"{some} look{'s' * (len(turned) == 1)} logged with the opposite sign"
    if mistake.inputs:
        a, b = (model.input_names[j] for j in mistake.inputs)
        signed = zip(mistake.inputs, mistake.signs, strict=True)
        odd = [model.input_names[j] for j, sign in signed if sign < 0]
        said = f"{a} and {b}" + f", with the sign of {listed(odd)} reversed," * bool(odd)
    else:
        said = ", ".join(listed(model.state_names[i] for i in pair) for pair in mistake.states)
    return f"the columns of {said} look exchanged"


def _swapped(model: Model, mistake: Mistake) -> str:
    """Return what the robot did, rather than what looks wrong in its log."""
    if mistake.inputs:
        a, b = (model.input_names[j] for j in mistake.inputs)
        return f"the robot did with {a} what was sent as {b}, and the reverse"
    said = ", ".join(listed(model.state_names[i] for i in pair) for pair in mistake.states)
    return f"the robot's sensors or program seem to exchange {said}"


def _exchanges(model: Model, shown: Sequence[int]) -> Iterator[Mistake]:
    """Yield exchanges of two inputs, and of two positions together with their velocities.

    Pairs with different units are included: the commands of a Twist are in m/s and rad/s, and a
    crane's trolley and load may be exchanged.
    """
    for pair in combinations(range(model.m), 2):
        yield Mistake(inputs=pair)
    exact = [r for r in integrals(model) if r.exact and {r.i, r.j} <= set(shown)]
    for a, b in combinations(exact, 2):
        if np.isclose(a.c, b.c):
            yield Mistake(states=((a.i, b.i), (a.j, b.j)))


def _turned(model: Model, shown: Sequence[int]) -> Iterator[Mistake]:
    """Yield sign faults: of each position with its velocity, and of each other state alone."""
    pairs = [(r.i, r.j) for r in integrals(model) if r.exact and {r.i, r.j} <= set(shown)]
    alone = [(i,) for i in shown if not any(i in pair for pair in pairs)]
    for group in sorted((*pairs, *alone)):
        yield Mistake(turned=group)


def other_input_units(model: Model, trials: Sequence[Trial]) -> Iterator[Mistake]:
    """Yield other units for all inputs that share a unit.

    For dimensionless inputs the largest command suggests the unit.
    """
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
    """Yield each change on which a trial is informative, with the fits as logged and as changed.

    None in place of the fits if the log is better as it is.
    """
    known = [i for i in shown if np.isfinite(trial.states[:, i]).any()]
    logged = Ahead(model, trial, known, starts)
    if not logged.enough or not np.isfinite(trial.inputs).all():
        return
    plain = logged.plain(np.ones(model.m)).score
    for change in changes:
        mended = Ahead(model, change.mended(trial), known, starts)
        if not mended.enough:
            continue
        gain = _gained(model, plain, mended, change)
        if gain < -HINT:
            yield change, None
        elif gain > HINT:
            fits = _compared(model, logged, mended, change)
            if fits is None and _act_exchanged(model, trial, change, known):
                before = logged.best([*_signed(model, change), *_odd_signs(model, change)])
                after = mended.best([np.ones(model.m)])
                fits = (before, after) if after.score < before.score else None
            yield change, fits


def _gained(model: Model, plain: float, mended: Ahead, change: Mistake) -> float:
    """Return by how much the model, not calibrated, predicts better without a fault [nats]."""
    return plain - min(mended.plain(gains).score for gains in _signed(model, change))


def _act_exchanged(model: Model, trial: Trial, change: Mistake, known: Sequence[int]) -> bool:
    """Check whether two inputs act as in the model only if their columns are exchanged.

    A model that lacks a lag or a dead zone predicts little better with the right columns. But if
    the wheels or thrusters of its two sides are exchanged, the robot turns the other way, by which
    both seem to act the other way round, and goes ahead as it should, by which neither does.
    """
    if not change.inputs or not change.swap:
        return False
    logged, mended = (
        {i: [acts[j].sign for j in change.inputs] for i, acts in each.items()}
        for each in (act_on_each(model, one, known) for one in (trial, change.mended(trial)))
    )
    turned = [i for i in logged if max(logged[i]) < 0 < min(mended.get(i, [0]))]
    right = [i for i in logged if min(logged[i]) > 0]
    return bool(turned and right) and all(min(signs) >= 0 for signs in mended.values())


def _compared(
    model: Model, logged: Ahead, mended: Ahead, change: Mistake
) -> tuple[Fit, Fit] | None:
    """Return both calibrated fits; None if the change is not clearly better after calibration."""
    signed, still = _signed(model, change), mended.still().score
    after = mended.best([min(signed, key=lambda gains: mended.plain(gains).score)])
    if not _plausible(change, after) or after.score > still - (CLEAR if change.swap else SEEN):
        return None
    before = logged.best(signed[:1], free=False)
    if not change.swap:
        after = mended.best(signed[:1], free=False)
        seen = change.factor < 1 or before.score > still + CLEAR  # too small has no effect
        return (before, after) if seen and _better(change, before, after) else None
    if _better(change, before, after):
        before = logged.best([*signed, *_odd_signs(model, change), np.zeros(model.m)])
    return (before, after) if _better(change, before, after) else None


def _better(change: Mistake, before: Fit, after: Fit) -> bool:
    part = PART if change.turned else HALF
    return before.score - after.score > CLEAR and bool((after.rms < part * before.rms).any())


def _plausible(change: Mistake, fit: Fit) -> bool:
    """Check whether the changed log has input gains near the model's; one sign may differ."""
    gains = fit.gains[list(change.inputs)]
    sized = (np.abs(gains) > 1 / LIKE) & (np.abs(gains) < LIKE)
    positive = (gains > 0).any() if change.swap else (gains > 0).all()
    return bool(np.all(sized)) and (not len(gains) or bool(positive))


def _signs(change: Mistake, fit: Fit) -> tuple[float, ...]:
    return tuple(float(np.sign(fit.gains[j])) for j in change.inputs) if change.swap else ()


def _signed(model: Model, change: Mistake) -> list[Array]:
    """Return initial gains: the model's, and those with one exchanged input's sign reversed."""
    found = [np.ones(model.m)]
    for j in change.inputs if change.swap else ():
        found.append(np.where(np.arange(model.m) == j, -1.0, 1.0))
    return found


def _odd_signs(model: Model, change: Mistake) -> list[Array]:
    """Return input signs that may explain the unchanged log: all reversed, or one."""
    if not (change.inputs or change.turned):
        return []
    one = [np.where(np.arange(model.m) == j, -1.0, 1.0) for j in range(model.m)]
    return [-np.ones(model.m), *(one if change.turned and model.m > 1 else ())]


def _best(found: Mapping[Mistake, Mapping[int, tuple[Fit, Fit]]]) -> Told:
    """Return the change with the smallest remaining error, with those that are nearly as good.

    Among these an exchange comes first. It is one mistake in [log], while a wrong sign of a sensor
    would be in the robot's program as well.
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
    """Return states whose sign reversal the model can't tell from the exchange; () if none."""
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
