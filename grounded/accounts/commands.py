"""What commands and motion show of each other: clocks that differ, inputs that act in reverse.

States that respond before their command is sent are on another clock, since no physics does that.
Under feedback commands follow the states, so later commands help to predict; and a model with too
much friction or lag is slower than the robot. So the later commands must act about as the model
says, and leave much smaller errors than the commands up to then can: through the model with gains,
delays and quicker actuators, or through any law that is linear in them.

How an input acts is judged by size. With everything linear in the states projected out (friction,
springs and the feedback itself are), predictions are made with the input as it is, reversed and
without effect. A reversed motor acts with a share near -1; a throttle that hardly moves on its own
may have any share, and tells nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.accounts.finding import UnusableTrials
from grounded.accounts.levels import FACTOR, FEWEST_SAMPLES, HALF, HINT, MARGIN, PART
from grounded.accounts.motion import (
    AHEAD_S,
    Ahead,
    Fit,
    basis,
    known_states,
)
from grounded.accounts.reported import names_of, tables
from grounded.findings import Finding, Quantity, found
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import integrals
from grounded.trial import Trial

HORIZONS = (AHEAD_S, 1.0)  # [s] how far ahead an input is judged
EARLY_S, REACH_S, GRID_S = 0.1, 1.0, 0.05  # [s] smallest and largest shift; calibrated near it
STARTS = 120  # samples to predict from


def judge_clocks(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> None:
    """Raise an error if states respond to commands before they are sent, in half of the trials."""
    each = {k: clocks_apart(model, one, shown) for k, one in enumerate(trials)}
    some = {k: told for k, told in each.items() if told}
    if some and 2 * len(some) >= len(each):  # one of many is a swing that sticks
        raise UnusableTrials(trials, list(some), next(iter(some.values())))


def clocks_apart(model: Model, trial: Trial, shown: Sequence[int]) -> Finding | None:
    """Return by how much the states of a trial lead its commands; None if they do not."""
    trial = trial.until(trial.known_steps)
    reach = min(round(REACH_S / trial.dt), trial.steps // 4)
    least, near = max(2, round(EARLY_S / trial.dt)), max(1, round(GRID_S / trial.dt))
    if reach <= least:
        return None
    seen = known_states(trial, shown)
    trial, known = _with_differences(model, trial, seen)
    ahead = Ahead(model, trial, known, STARTS, linear=True, early=reach)
    ones = np.ones(model.m)

    def as_told(k: int) -> Fit:
        free = ahead.best([ones], late=-k)
        like = ((free.gains > 1 / FACTOR) & (free.gains < FACTOR)).all()
        return free if like else ahead.best([ones], free=False, late=-k)

    with np.errstate(all="ignore"):
        if not ahead.enough:
            return None
        # the shift that the model as it is likes best, then its neighbours, calibrated
        shifts = np.arange(least, reach + 1, near)
        moved = ahead.scores(ones, -shifts)
        about = int(shifts[np.argmin(moved)])
        if moved.min() > ahead.plain(ones).score - HINT:
            return None
        fits = {
            k: as_told(k) for k in range(max(least, about - near), min(reach, about + near) + 1)
        }
        k = min(fits, key=lambda k: fits[k].score)
        # all that past and present commands can do
        before = ahead.whatever_commands_do().best([ones])
    parts, gain = fits[k].rms / before.rms, before.score - fits[k].score
    if gain < MARGIN or parts.min() > HALF:
        return None
    names, state = names_of(model, seen), min(seen, key=lambda i: float(parts[i]))
    name = model.state_names[state]
    logged_s, mended_s = (
        Quantity(float(fit.rms[state]), model.states[name]) for fit in (before, fits[k])
    )
    told = found("log.clock", *names, state=name, lead=k * trial.dt, nats=gain)
    return told.also(tables=tables(model, names), logged=logged_s, mended=mended_s)


def _with_differences(model: Model, trial: Trial, known: list[int]) -> tuple[Trial, list[int]]:
    """Fill in unmeasured velocities by central differences of their positions."""
    states, w = np.array(trial.states), max(1, round(0.04 / trial.dt))
    found = list(known)
    for one in integrals(model):
        if one.exact and one.i in known and one.j not in found and trial.steps > 2 * w:
            x = states[:, one.i]
            states[:, one.j] = np.nan
            states[w:-w, one.j] = (x[2 * w :] - x[: -2 * w]) / (2 * w * trial.dt * one.c)
            found.append(one.j)
    return replace(trial, states=states), sorted(found)


@dataclass(frozen=True)
class Acts:
    """How an input acts in a trial."""

    sign: int  # 1 as in the model, -1 the other way round, 0 if the trial does not show it
    share: float  # its effect as a share of the modelled one, below 0 the other way round


UNKNOWN = Acts(0, float("nan"))


def how_inputs_act(model: Model, trial: Trial, shown: Sequence[int]) -> tuple[Acts, ...]:
    """Return how each input acts in the part of a trial without gaps."""
    known = trial.until(max(trial.known_steps, 0))
    some = known_states(known, shown)
    if not some or not np.isfinite(known.inputs).all():
        return (UNKNOWN,) * model.m
    found = list[tuple[Array, Array]]()
    with np.errstate(all="ignore"):
        for seconds in HORIZONS:
            ahead = Ahead(model, known, some, STARTS, linear=True, horizon=seconds)
            if ahead.enough:
                found.append(_scores(ahead))
    return tuple(_acts([(nats[j], shares[j]) for nats, shares in found]) for j in range(model.m))


def _scores(ahead: Ahead) -> tuple[Array, Array]:
    """Return what is missed [nats] with each input forth, without and back (m, 3), and its share.

    What an input does is all but linear in it, so that its share can be fitted; predictions for
    which it is not are left out. The commands may act late. NaN for an input that hardly moves on
    its own.
    """
    m = ahead.model.m
    gains = np.vstack([np.ones(m), 1.0 - np.eye(m), 1.0 - 2.0 * np.eye(m)])
    nats, shares = np.full((m, 3), np.nan), np.full(m, np.nan)
    least = np.full(m, np.inf)
    late = np.repeat(np.array(ahead.delays), len(gains))
    every = ahead.missed(np.tile(gains, (len(ahead.delays), 1)), ahead.model.values, late)
    for off in every.reshape(len(ahead.delays), len(gains), *every.shape[1:]):
        by = off[:1] - off[1 : m + 1]  # what each input does (m, N, k)
        bent = off[:1] - off[m + 1 :] - 2 * by
        size = np.square(by / ahead.least).sum(axis=(0, 2))
        even = np.square(bent / ahead.least).sum(axis=(0, 2)) <= HALF**2 * size
        even &= np.isfinite(off).all(axis=(0, 2))
        if even.sum() < FEWEST_SAMPLES:
            continue
        linear = basis(ahead.first[even][:, ahead.shown])
        each = np.concatenate([off[:1], by])[:, even]
        own = each - np.einsum("nc,xck->xnk", linear, np.einsum("nc,xnk->xck", linear, each))
        moved = np.square((each - each.mean(axis=1, keepdims=True)) / ahead.least).sum(axis=(1, 2))
        alone = np.sqrt(np.square(own / ahead.least).sum(axis=(1, 2)) / moved)[1:]
        for j in np.flatnonzero(alone > PART).tolist():
            tried = [_left(ahead, own, j, share) for share in (1.0, 0.0, -1.0)]
            nats[j] = np.fmin(nats[j], [score for score, _ in tried])
            if (best := _left(ahead, own, j, None))[0] < least[j]:
                least[j], shares[j] = best
    return nats, shares


def _left(ahead: Ahead, own: Array, j: int, share: float | None) -> tuple[float, float]:
    """Return what is missed [nats] with a share of input j, None: the best one; and that share."""
    free = [k for k in range(len(own) - 1) if k != j or share is None]
    rest = own[0] + (0.0 if share is None else share - 1.0) * own[1 + j]
    left, shares = rest, np.zeros(len(free))
    for _ in range(3):  # weighted by what each state misses
        size = ahead.size(left)
        design = (own[1:][free] / size).reshape(len(free), rest.size).T
        shares = np.linalg.lstsq(design, -(rest / size).ravel(), rcond=1e-6)[0]
        left = rest + np.einsum("x,xnk->nk", shares, own[1:][free])
    found = 1.0 + float(shares[free.index(j)]) if share is None else share
    return float(np.log(ahead.size(left)).sum()), found


def _acts(each: Sequence[tuple[Array, float]]) -> Acts:
    """Return how an input acts, if predictions of both lengths agree on it.

    Over one of them its way must lead, over the other do better than its reverse: resistance that
    the model lacks leaves less of an input the longer it acts.
    """
    known = [(nats, share) for nats, share in each if np.isfinite(nats).all()]
    if len(known) < len(HORIZONS):
        return UNKNOWN
    leads = [
        float(np.delete(nats, k).min() - nats[k]) for nats, _ in known for k in [nats.argmin()]
    ]
    nats, share = known[next((k for k, lead in enumerate(leads) if lead > HINT), 0)]
    way = int(nats.argmin())
    agree = min(float(one[2 - way] - one[way]) for one, _ in known)
    sized = 1 / FACTOR < (1 - way) * share < FACTOR
    clear = way != 1 and max(leads) > HINT and agree > HINT * (way == 2)
    return Acts(1 - way if clear and sized else 0, float(share))


def judge_signs(model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> None:
    """Raise an error if an input acts the other way round in some trials than in others."""
    if len(trials) < 2:
        return
    acts = [how_inputs_act(model, trial, shown) for trial in trials]
    for name, every in zip(model.input_names, zip(*acts, strict=True), strict=True):
        right, wrong = ([k for k, one in enumerate(every) if one.sign == s] for s in (1, -1))
        if not (right and wrong):
            continue
        # the fewer are wrong, and of equally many those that contradict the model
        odd, rest = (wrong, right) if len(wrong) <= len(right) else (right, wrong)
        share, usual = every[odd[0]].share, every[rest[0]].share
        others = tuple(trials[k].id or f"trial number {k + 1}" for k in rest)
        raise UnusableTrials(
            trials, odd, found("log.reversed", name, others=others, share=share, usual=usual)
        )
