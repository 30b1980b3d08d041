"""Limits of the data, checked before anything is claimed: which effects can't be identified.

If a state never moved, an input never changed, or there is a single trial or only a few steps, an
effect may exist but can't be identified. It is not a candidate then, and a finding says why.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from grounded.accounts.finding import Preflight
from grounded.accounts.lag import whole_steps
from grounded.accounts.sound_trials import sound_trials
from grounded.checks import refused
from grounded.diagnosis.levels import ROUNDING
from grounded.diagnosis.likelihood.data import PIECES, SHORTEST_PIECE, Data, prepare
from grounded.effects import (
    Effect,
    InputFamily,
    Library,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    RateFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
    param_name,
)
from grounded.effects.actuator import backlash
from grounded.findings import Finding, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import MOVES_STATE, told_by
from grounded.share import share_of
from grounded.task import Task
from grounded.trial import Trial, scattered

FEW_STEPS = 30
SAMPLES = 20  # of the slopes by which inputs are compared


@dataclass(frozen=True)
class Limits:
    """What can't be identified, and whether no cause may be named, for the first of these."""

    findings: tuple[Finding, ...]
    no_cause: bool


MOST_STATES = 50  # of a filter, whose step costs their cube; of a diagnosis with the inputs


@dataclass(frozen=True, eq=False)
class Sound:
    """The data of a likelihood, and what was found while they were made sound."""

    data: Data
    looked: Preflight  # what the sensors show by themselves
    limits: Limits
    first: int  # trials of the first of two groups that are compared
    exact: bool  # all trials repeat each other to the last bit: there is no noise
    shares: tuple[Finding, ...] = ()  # which parts of the trials are used, if not all


def sound_data(
    subject: Task | Model,
    trials: Sequence[Trial],
    compare: Sequence[Trial] = (),
    *,
    what: str = "diagnosis",
    hidden: Sequence[str] = (),
    one_message: Sequence[str] = (),
    interpolated_s: float = 0.0,
) -> Sound:
    """Correct the sensors, count copies once, cut trials into runs, see what they can't show.

    Args:
        subject: the task (its latency counts as modelled) or a model.
        trials: real runs with one time step.
        compare: those of a second group.
        what: they are for, told if there are too many states.
        hidden: names of states without a sensor, such as the memory of adopted effects.
        one_message: states that are logged in one message.
        interpolated_s: standard deviation of times [s] because the states were interpolated.

    Raises:
        GroundedError: if the trials don't fit the model, or hold no data, or it is too large.
    """
    model = subject.model if isinstance(subject, Task) else subject
    if model.n + model.m > MOST_STATES:
        sizes = {"states": model.n, "inputs": model.m, "most": MOST_STATES, "what": what}
        raise refused("given.large", f"model '{model.name}'", **sizes)
    latency = subject.latency if isinstance(subject, Task) else None
    past = subject.past if isinstance(subject, Task) else None

    # part of very long logs; copies once
    shares = share_of(trials), share_of(compare)
    (trials, copies), (compare, more) = (counted_once(share.trials) for share in shares)
    first = len(trials) if compare else None
    looked = sound_trials(subject, [*trials, *compare], hidden, first, one_message)

    # late logs of whole steps are shifted, filters are undone in the likelihood; those of adopted
    # filters that sensors show alone are held, as the physics would fit what it lacks with them
    seen = {f"sensor_lag_{one.signal}_tau" for one in looked.findings if one.kind == "lag"}
    model = model.holding(seen & {*model.params})
    data = prepare(model, looked.trials, latency, past, hidden)
    filters = {model.state_names.index(name): tau for name, tau in looked.filters.items()}
    moved = [f for f in looked.findings if f.corrected and f.kind == "delay"]
    between = {f.signal for f in moved if not whole_steps(f.delay_s / data.dt)}
    data = replace(data, filters=filters, between=frozenset(between), interpolated_s=interpolated_s)
    known = limits(data, looked.left_out)
    told = tuple(share.finding for share in shares if share.finding)
    known = replace(known, findings=(*known.findings, *copies, *more, *told))
    exact = bool(copies or more) and not (scattered(trials) or scattered(compare))
    return Sound(data, looked, known, sum(trial.known_steps >= 2 for trial in trials), exact, told)


def limits(data: Data, left_out: Collection[str] = ()) -> Limits:
    """Report what can't be identified because trials are too few or lack excitation.

    Args:
        data: the trials.
        left_out: names of states whose sensors are redundant and were left out.
    """
    told, no_cause, model = list[Finding](), False, data.model
    if data.count < 2 and len(data.valid) < PIECES:
        told.append(found("model.few", needed=PIECES * SHORTEST_PIECE))
        no_cause = True
    if data.steps < FEW_STEPS:
        told.append(found("model.few", steps=data.steps, needed=FEW_STEPS))
        no_cause = True
    moved = excitation(data)
    if moved.still or moved.unmoved:
        told.append(found("model.still", *moved.still, *moved.unmoved))
    # where all commands were 0, as in a free swing, no actuator stands behind what is seen
    no_cause |= len(moved.still) == model.m and bool(data.commands.any())
    if data.skipped:
        used = len(data.valid)
        told.append(found("model.share", used=used, total=used + data.skipped, stretches=True))
    names = model.state_names
    empty = [name for name, seen in zip(names, data.told, strict=True) if not seen]
    spared = {*left_out, *(names[i] for i, log in data.behind.items() if names[log] in left_out)}
    if missing := [name for name in empty if name not in spared]:
        told.append(found("model.unmeasured", *missing))
    no_cause |= {*moved.unmoved, *empty, *moved.memory} == {*names}
    return Limits(tuple(told), no_cause)


def counted_once(trials: Sequence[Trial]) -> tuple[list[Trial], list[Finding]]:
    """Drop trials that equal an earlier one up to rounding; return the rest and a finding each.

    A copy has the same noise. If it were counted twice, it would confirm what a single run shows.
    """
    known: dict[tuple[int, ...], list[tuple[int, Trial]]] = {}
    kept, told = [], []
    for k, trial in enumerate(trials):
        alike = known.setdefault(trial.states.shape, [])
        other = next(((i, t) for i, t in alike if _is_copy(trial, t)), None)
        if other is None:
            alike.append((k, trial))
            kept.append(trial)
            continue
        name, first = (t.id or f"trial {i + 1}" for i, t in ((k, trial), other))
        told.append(found("model.copy", name, first=first))
    return kept, told


def _is_copy(trial: Trial, other: Trial) -> bool:
    """Check whether two trials of one length have the same states and inputs up to rounding."""

    def same(a: Array, b: Array) -> bool:
        off = ROUNDING * np.max(np.abs(b), axis=0, where=np.isfinite(b), initial=0.0)
        return np.allclose(a, b, rtol=0.0, atol=off, equal_nan=True)

    return same(trial.states, other.states) and same(trial.inputs, other.inputs)


@dataclass(frozen=True)
class Excitation:
    """What moved in the trials: names of inputs and states.

    Attributes:
        still: inputs with one value.
        on_off: inputs that were only on or off, whose effects on the amplitude can't be known.
        sent: {input: those with the same commands up to a factor, itself included}.
        same: those of them that also move all states alike, so no trial tells whose effect it is.
        unmoved: states with one value, so that their sensor seems dead.
        unseen: states that no sensor shows, without the memory of adopted effects.
        memory: states of that memory.
    """

    still: tuple[str, ...]
    on_off: frozenset[str]
    sent: Mapping[str, tuple[str, ...]]
    same: Mapping[str, tuple[str, ...]]
    unmoved: tuple[str, ...]
    unseen: frozenset[str]
    memory: frozenset[str]


@lru_cache(maxsize=1)
def excitation(data: Data) -> Excitation:
    """Return what moved in the trials."""
    model = data.model
    commands = np.concatenate([data.commands[i, :T] for i, T in enumerate(data.lengths)])
    shown = [n for i, n in enumerate(model.state_names) if i not in data.hidden]

    def moves(name: str, values: Array) -> bool:
        return float(np.ptp(values)) > ROUNDING * max(data.scales.peak(name), 1e-12)

    inputs = dict(zip(model.input_names, commands.T, strict=True))
    states = {n: data.states[:, model.state_names.index(n)] for n in shown}
    states = {n: values[np.isfinite(values)] for n, values in states.items()}
    still = tuple(n for n, values in inputs.items() if not moves(n, values))
    levels = {n: np.unique(values) for n, values in inputs.items()}

    # copies of each other, by what was sent and by what it moves
    like = same = _proportional(commands, ROUNDING)
    if like.sum() > model.m:
        x, u = data.y[:-1].reshape(-1, model.n), data.runs(data.commands).reshape(-1, model.m)
        at = np.linspace(0, len(x) - 1, SAMPLES).astype(int)
        with np.errstate(all="ignore"):
            slopes = model.system.linearise(x[at], u[at], model.values, data.dt)[1]
        same = like & _proportional(slopes.reshape(-1, model.m), MOVES_STATE)

    def groups(like: Any) -> dict[str, tuple[str, ...]]:
        names = {name: j for j, name in enumerate(model.input_names) if name not in still}
        return {one: tuple(n for n in names if like[names[one], names[n]]) for one in names}

    return Excitation(
        still,
        frozenset(n for n, own in levels.items() if own.size == 2 and 0.0 in own),
        groups(like),
        groups(same),
        tuple(n for n, values in states.items() if values.size and not moves(n, values)),
        frozenset(n for n in shown if not data.seen[..., model.state_names.index(n)].any()),
        frozenset(model.state_names) - {*shown},
    )


def _proportional(columns: Array, off: float) -> Any:
    """Return which columns (N, m) are multiples of each other, (m, m), `off` relative to them."""
    peak = columns[np.abs(columns).argmax(axis=0), np.arange(columns.shape[1])]
    unit = columns / np.where(peak == 0, 1.0, peak)
    away = (np.abs(unit[:, :, None] + sign * unit[:, None]).max(axis=0) for sign in (-1, 1))
    return (np.minimum(*away) <= off) | np.eye(columns.shape[1], dtype=bool)


def knowable(
    data: Data, effects: Sequence[Effect], whole: Collection[str] = ()
) -> tuple[Effect, ...]:
    """Return the effects that these data could show.

    An effect of several inputs is that of those which move: a delay of all commands shows in two of
    four joints while the others stand still. An effect of an input is that of all its copies, too.

    Args:
        data: the trials.
        effects: all candidates.
        whole: names of effects that the model has already, which stay as they are.
    """
    moved, sensors = excitation(data), SensorFamily | SensorDelayFamily | SensorLagFamily
    still, unmoved, unseen = {*moved.still}, {*moved.unmoved}, {*moved.unseen}
    copied = {name for name, group in moved.same.items() if len(group) > 1}
    kept = []
    for effect in _of_moving(data, effects, whole, moved):
        family, targets = effect.family, effect.site.targets
        acts = {part for t in targets for part in t.split("<-")}
        if isinstance(family, LossFamily):  # a wheel turns, even if the robot does not
            acts = {*targets[0].split("<-")}
        lost = {*moved.memory}
        if isinstance(family, InputFamily | MemoryFamily | RateFamily):
            # what the model has already needs one of its inputs to move
            lost |= still - acts if effect.name in whole and not acts <= still else still
        if isinstance(family, InputFamily) or family is backlash:
            lost |= moved.on_off
        if isinstance(family, RateFamily):
            lost |= copied  # one of several copies: none of them can be blamed
        if isinstance(family, RateFamily | LossFamily | MediumFamily | sensors):
            lost |= unmoved
        if isinstance(family, sensors):
            lost |= unseen
        late = isinstance(family, SensorDelayFamily) and len(targets) > 1
        told = not late or told_by(data.model, targets) - unseen - unmoved - moved.memory
        if told and family.shows(effect.site) and not acts & lost:
            kept.append(effect)
    return tuple(kept)


def _of_moving(
    data: Data, effects: Sequence[Effect], whole: Collection[str], moved: Excitation
) -> list[Effect]:
    """Replace effects of inputs by those of the inputs that move and of all of their copies."""
    named, found = set[str](), list[Effect]()
    for effect in effects:
        site, family = effect.site, effect.family
        if not isinstance(family, InputFamily | MemoryFamily) or effect.name in whole:
            found.append(effect)
            continue
        lost = {*moved.still, *(moved.on_off if isinstance(family, InputFamily) else ())}
        shown = tuple(name for name in site.targets if name not in lost)
        targets = shown if len(shown) > 1 else site.targets
        # of those that no trial tells apart, and of all that are sent the same
        for groups in (moved.same, moved.sent):
            joined = {name for one in targets for name in groups.get(one, (one,))}
            several = tuple(name for name in data.model.input_names if name in joined)
            name = replace(effect, site=replace(site, targets=several)).name
            if name not in named:
                named.add(name)
                found.append(family.at(replace(site, targets=several)))
    return found


def without_others(data: Data, adopted: Collection[str], library: Library) -> Model:
    """Return the model with the values of adopted effects held that one motion can't determine.

    These are effects without a mechanism, if all trials are of one group: their values were found
    from other trials.

    Args:
        data: the trials.
        adopted: names of the adopted effects, whose values are parameters of the model.
        library: source of the effects.
    """
    model, held = data.model, set[str]()
    for name in adopted if len(data.groups) == 1 < data.count else ():
        of, _, target = name.partition(":")
        family = library.family(of)
        if family.loose and target in family.targets(model):
            effect = library.effect(name, model, data.scales)
            held |= {param_name(name, q.name) for q in effect.quantities}
    return model.holding(held)
