"""Find inputs that act the other way round in a trial: a motor wired wrongly, a sign switched.

How strongly an input acts is fitted to predictions a quarter of a second ahead (`Acting`), after
everything linear in the states is removed from them. Friction, springs and the feedback itself are
linear, and would make a right input seem to act the wrong way round. Only predictions count in
which the effect of an input is nearly linear in it: an arm that whirls ends anywhere, and with the
commands of one sign the prediction may diverge and with the other not.

A model may be crude, but its signs are right in most cases: if trials contradict each other, the
fewer are wrong, and of equally many those that contradict the model. A reversed motor does about -1
times what is modelled. An input that hardly moves by itself explains what the model lacks, by any
factor and with any significance. So a sign counts by its size, and only of an input that moves on
its own: by more than follows linearly from the states.

Feedback through late or lagging commands makes a robot swing. A swing is all but linear in the
states, up to harmonics, and a third harmonic is turned round by a delay of a sixth of the period:
no sign is judged by such a trial unless all delays agree on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded.instruments.finding import UnusableTrials
from grounded.instruments.predictions.short_runs import LEAST, SAME, Ahead, basis
from grounded.model import Model
from grounded.result import listed
from grounded.trial import Trial

STARTS = 120  # samples to predict from
# standard errors from 0 from which on an input acts the other way round, or as in the model
SURE, USUAL = 6.0, 3.0
SHOWN = 0.2  # least share of its modelled effect from which on an input shows its sign
STRONGER = 2.0  # largest share of one the other way round: a crude model's gain is within a factor
DELAYS, LONGEST = 13, 0.3  # number of delays tried from 0 to the longest [s]
AS_WELL = 0.5  # [nats] by which a fit with the other sign must be worse
BETTER = 0.1  # [nats] by which a fit in which an input does nothing must be better
ROUNDS = 5  # iterations
BLOCKS = 12  # stretches of a trial whose scatter gives a standard error
BENT = 1.001  # largest deviation from a linear effect, as a share of the effect
FARTHEST = 100.0  # times as far as the states move: farther, a prediction diverges
TINY = 1e-3  # of how far the states move: a deviation that is always small enough


@dataclass(frozen=True)
class Acts:
    """How an input acts in a trial.

    Args:
        sign: 1 as in the model, -1 the other way round, 0 if the trial does not show it.
        share: its effect as a share of the modelled one, below 0 the other way round.
        error: standard error of the share.
    """

    sign: int
    share: float
    error: float

    @property
    def told(self) -> str:
        """The share in percent."""
        return f"{100 * self.share:.0f} %"


UNKNOWN = Acts(0, float("nan"), float("nan"))


def how_inputs_act(model: Model, trial: Trial, shown: Sequence[int]) -> tuple[Acts, ...]:
    """Return how each input acts in a trial.

    Args:
        model: however crude, with the effects adopted.
        trial: of its states and inputs; only its part without gaps is used.
        shown: indices of the states with a sensor.
    """
    if (ahead := _ahead_of(model, trial, shown)) is None:
        return (UNKNOWN,) * model.m
    with np.errstate(all="ignore"):
        prompt = Acting(ahead, 0)
        fit = prompt.strengths(prompt.even)
        found = _each(fit) if fit else (UNKNOWN,) * model.m
        if any(one.sign < 0 for one in found):
            fits = _by_longest_delay(ahead, prompt)
            found = tuple(_agreed(fits, i) for i in range(model.m))
    return found


def act_on_each(model: Model, trial: Trial, shown: Sequence[int]) -> dict[int, tuple[Acts, ...]]:
    """Return how each input acts on each state by itself, with commands that act at once.

    Arguments as of `how_inputs_act`; empty if too little is known.
    """
    if (ahead := _ahead_of(model, trial, shown)) is None:
        return {}
    with np.errstate(all="ignore"):
        prompt = Acting(ahead, 0)
        fits = {i: prompt.strengths(prompt.even, k) for k, i in enumerate(ahead.shown)}
    return {i: _each(fit) for i, fit in fits.items() if fit}


def _ahead_of(model: Model, trial: Trial, shown: Sequence[int]) -> Ahead | None:
    """Return predictions of a trial's part without gaps; None if too little is known."""
    known = trial.until(max(trial.known_steps, 0))
    some = [i for i in shown if np.isfinite(known.states[:, i]).any()]
    if not some or not np.isfinite(known.inputs).all():
        return None
    ahead = Ahead(model, known, some, STARTS, (0.0,))
    return ahead if ahead.enough else None


def _each(fit: Strengths) -> tuple[Acts, ...]:
    return tuple(_acts(fit, i) for i in range(len(fit.factors)))


def _acts(fit: Strengths, i: int) -> Acts:
    share, error = float(fit.factors[i]), float(fit.errors[i])
    wrong = -STRONGER - error < share < min(-SHOWN, -SURE * error) and fit.own[i] > SHOWN
    return Acts(-1 if wrong else int(share > max(SHOWN, USUAL * error)), share, error)


def _by_longest_delay(ahead: Ahead, prompt: Acting) -> list[list[Strengths]]:
    """Return the fits with each delay up to a longest one, for every longest one, best first.

    The commands before a trial are unknown, so each of them uses the predictions after the longest
    delay only. Empty lists have too few.
    """
    delays = sorted({round(d / ahead.dt) for d in np.linspace(0.0, LONGEST, DELAYS)})
    each = [prompt, *(Acting(ahead, late) for late in delays[1:])]
    even = np.logical_and.reduce([one.even for one in each])
    found = []
    for longest in delays:
        fits = [e.strengths(even & (ahead.at >= longest)) for e in each if e.late <= longest]
        found.append(sorted((f for f in fits if f and np.isfinite(f.score)), key=lambda f: f.score))
    return found


def _agreed(found: list[list[Strengths]], i: int) -> Acts:
    """Return how input i acts, with sign 0 unless all longest delays that show one agree on it."""
    best = [_acts(fits[0], i) for fits in found if fits]
    sure = [one for one in best if one.sign]
    doubtful = not found[-1] or any(_contested(fits, i) for fits in found)
    if doubtful or len({one.sign for one in sure}) > 1:
        return UNKNOWN
    return next(iter(sure), UNKNOWN)


def _contested(fits: list[Strengths], i: int) -> bool:
    """Return whether another delay explains the trial about as well with the other sign.

    Or better without any: beside a stuck joint whose command lagged, the torque on the other joint
    seemed to act by -21 % if it came at once, and by 2 %, with smaller errors, 0.1 s later.
    """
    if not fits:
        return False
    if not _acts(fits[0], i).sign:
        known = [f for f in fits[1:] if _acts(f, i).sign]
        return bool(known) and known[0].score > fits[0].score + BETTER
    near = [fit.factors[i] for fit in fits if fit.score < fits[0].score + AS_WELL]
    return any(factor * near[0] < 0 for factor in near)


def judge_signs(model: Model, trials: Sequence[Trial], hidden: Sequence[str] = ()) -> None:
    """Raise an error if an input acts the other way round in some trials than in others.

    Args:
        model: however crude, with the effects adopted.
        trials: already corrected for other faults, see `preflight`.
        hidden: states without a sensor.

    Raises:
        GroundedError: naming the trials and the input, and what to do.
    """
    if len(trials) < 2:
        return
    shown = [i for i, name in enumerate(model.state_names) if name not in hidden]
    acts = [how_inputs_act(model, trial, shown) for trial in trials]
    for name, every in zip(model.input_names, zip(*acts, strict=True), strict=True):
        right, wrong = ([k for k, one in enumerate(every) if one.sign == s] for s in (1, -1))
        if right and wrong:
            odd, rest = (wrong, right) if len(wrong) <= len(right) else (right, wrong)
            raise _contradiction(trials, name, odd, rest, every)


def _contradiction(
    trials: Sequence[Trial],
    name: str,
    odd: Sequence[int],
    rest: Sequence[int],
    acts: Sequence[Acts],
) -> UnusableTrials:
    """Return the error that an input acts the other way round in the trials `odd`."""
    ids, others = ([trials[k].id or f"number {k + 1}" for k in some] for some in (odd, rest))
    against = acts[odd[0]].sign < 0
    said = (
        f"{name} acts the other way round than in {listed(others)}"
        f"{' and in the model' if against else ', though as in the model'} "
        f"({acts[odd[0]].told} of its modelled effect, in {others[0]} {acts[rest[0]].told}): no "
        "model explains both"
    )
    these = "this trial" if len(odd) == 1 else "these trials"
    mend = (
        f"Was a motor wired otherwise, or a sign switched? Then discard {these}, mend it and run "
        "again. If only the log has the other sign, correct the log and ingest it again"
    )
    where = f"in trial{'s' * (len(odd) > 1)} {listed(ids)}"
    then = NextCommand("discard", tuple(ids)) if trials[0].id else None
    return UnusableTrials(f"{where} {said}. {mend}", said, mend, said, then)


@dataclass(frozen=True)
class Strengths:
    """How strongly the inputs act.

    Args:
        factors: 1 as in the model, below 0 the other way round (m,); NaN if the log does not show
            it.
        errors: their standard errors (m,).
        score: sum of the logarithms of the errors that are left [nats].
        own: the part of what they do that does not follow the states linearly (m,).
    """

    factors: Array
    errors: Array
    score: float
    own: Array


class Acting:
    """Predictions with commands that are carried out `late` steps late.

    Args:
        ahead: predictions of a trial.
        late: the delay [steps].
    """

    def __init__(self, ahead: Ahead, late: int) -> None:
        m, self.ahead, self.late = ahead.model.m, ahead, late
        gains = np.vstack([np.ones(m), 1.0 - 2.0 * np.eye(m), 1.0 - np.eye(m)])
        off = ahead.missed(gains, ahead.model.values, late)
        self.off, turned, without = off[0], off[1 : m + 1], off[m + 1 :]
        self.by = np.moveaxis(self.off - turned, 0, -1) / 2  # (N, shown, m): what each input does
        bent = np.moveaxis((self.off + turned) / 2 - without, 0, -1)
        moved = (ahead.moved[ahead.shown] + ahead.least)[:, None]
        does, strays = ((np.abs(x * self.by) / moved**2).sum(axis=1) for x in (self.by, bent))
        even = ((strays <= BENT * does + TINY**2) & (does < FARTHEST**2)).all(axis=1)
        self.even: NDArray[np.bool_] = even & np.isfinite(off).all(axis=(0, 2))

    def strengths(self, rows: NDArray[np.bool_], only: int | None = None) -> Strengths | None:
        """Fit how strongly each input acts; None with too few predictions.

        Args:
            rows: which predictions to use (N,).
            only: the state to fit, of those shown; None: all.
        """
        found, error = np.full((2, self.ahead.model.m), np.nan)
        if rows.sum() < LEAST:
            return None
        linear, size_of = basis(self.ahead.first[rows][:, self.ahead.shown]), self.ahead.size
        counts = np.ones(self.off.shape[1]) if only is None else np.eye(self.off.shape[1])[only]
        off, by = self.off[rows] * counts, self.by[rows] * counts[:, None]
        off = off - linear @ (linear.T @ off)
        size, varies = size_of(off), by - by.mean(axis=0)
        by = by - np.einsum("nc,cki->nki", linear, np.einsum("nc,nki->cki", linear, by))
        whole, left = (np.einsum("nki,k->i", a**2, size**-2.0) for a in (varies, by))
        own = np.sqrt(left / np.maximum(whole, 1e-300))
        acts = np.asarray((np.sqrt((by**2).mean(axis=0)) > self.ahead.least[:, None]).any(axis=0))
        if not acts.any():
            return Strengths(found, error, float(np.log(size).sum()), own)
        by = by[:, :, acts]
        for _ in range(ROUNDS):
            slopes = by / size[:, None]
            inverse = np.linalg.pinv(np.einsum("nki,nkj->ij", slopes, slopes), SAME, hermitian=True)
            change = -inverse @ np.einsum("nki,nk->i", slopes, off / size)
            left = off + by @ change
            size = size_of(left)
        pulls = _in_blocks(np.einsum("nki,nk->ni", slopes, left / size))
        found[acts] = 1.0 + change
        error[acts] = np.sqrt(np.diag(inverse @ (pulls.T @ pulls) @ inverse))
        return Strengths(found, error, float(np.log(size).sum()), own)


def _in_blocks(each: Array) -> Array:
    """Sum rows (N, k) over stretches of the trial whose errors count as independent."""
    block = np.arange(len(each)) * BLOCKS // len(each)
    sums = [np.bincount(block, column, minlength=BLOCKS) for column in each.T]
    return np.asarray(np.array(sums).T * np.sqrt(BLOCKS / (BLOCKS - 1)))
