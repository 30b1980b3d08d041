"""Maximum-likelihood fits of many hypotheses at once: effects, parameters, noise and track.

Each iteration of a fit predicts along the hypothesis' own track, whitens the residual with the
Kalman filter, takes one Gauss-Newton step in the effects' values and the parameters' shifts and one
scoring step in the noise, and makes the filtered track the new track. It repeats until the
posterior no longer rises: the likelihood times the prior of the shifts, whose slope the steps
follow. Each step starts from the best point so far; a step that does not raise the posterior is
shortened (`Work`). A track filtered with a wrong model hides the model's error, so every hypothesis
has a track of its own.

The shifts of the model's parameters have a normal prior and are integrated out at this maximum
(Laplace), with G their Fisher information:

    log p(y | h) = loglik - shift' P shift / 2 - log det(1 + P^-1 G) / 2,   P = (spread scale)^-2

Hypotheses with the same noise structure are filtered together, along the batch axis.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import Delays, delays_of
from grounded.diagnosis.likelihood.fitted import Fitted, calibrated, moved, shift_precision
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.linearise import (
    columns_of,
    filter_system,
    gains_of,
    linearise,
    sensitivities_of,
    smoothed,
)
from grounded.diagnosis.likelihood.noise import (
    NoiseModel,
    Structure,
    average,
    cleaned,
    climbed,
    likelihood_slopes,
    started,
    working,
)
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.likelihood.step import ProposedStep, inside, proposed
from grounded.engine import each
from grounded.filter import kalman
from grounded.filter.augmented import Delayed, joined
from grounded.filter.kalman import LinearSystem
from grounded.frozen import Array

MOST_NUMBERS = 1e5  # size of one (L, B, N, N) array of a block; what fits in the cache is fastest
SHORTEST = 0.05  # smallest fraction of a step that is tried
RIVAL_NATS = 10.0  # nats behind the best within which all rivals continue
RIVAL_PROMISE = 2.0  # times what its next step promises that a rival may gain
# iterations of a round of a simulator, whose slopes are kept during a round
ITERATIONS_PER_ROUND = 4
PROMISE_SHORTENED = 0.1  # nats that a shortened step must promise to be tried
PROMISE_LAST = 0.01  # nats: after a rise below RISE_MAY_END, a step that promises less is not tried
RISE_MAY_END = 1.0  # nats: smaller rises may end a fit
RISE_ENDS = 0.03  # nats: smaller rises do end it


@dataclass(eq=False)
class Work:
    """The state of the fit of one hypothesis: mutable, private to this module."""

    h: Hypothesis
    noise: NoiseModel
    track: Array
    best: Fitted | None = None
    step: ProposedStep | None = None
    part: float = 1.0  # fraction of the step that is taken
    still: bool = False  # the likelihood no longer rises
    given_up: bool = False  # can't catch up with its rivals
    moving: bool = True  # the track moves with the step; at kinks of the model this may not help
    along: Predictor | None = None  # predictor of its own track, during the fit
    # of the thresholds PROMISE_SHORTENED, PROMISE_LAST and RISE_ENDS, below which it ends
    share: float = 1.0

    def shorten(self, data: Data) -> None:
        """Retry the step with the track held, then shorter ones; stop if they are too short."""
        if self.moving:
            self.moving = False
        else:
            self.part *= 0.4
        if self.step is None or self.part < SHORTEST or self.hope < PROMISE_SHORTENED * self.share:
            self.still = True
        else:
            self.go(data)

    @property
    def hope(self) -> float:
        """The gain that the quadratic model expects of the next (shortened) step [nats]."""
        return 0.0 if self.step is None else self.step.promise * self.part * (2 - self.part)

    def go(self, data: Data) -> None:
        """Move from the best point by the current fraction of the step."""
        assert self.best is not None
        assert self.step is not None
        best, step, part = self.best, self.step, self.part
        self.h = moved(data, best.hypothesis, part * step.delta)
        if len(step.delta) > len(self.h.theta) and self.h.shift is not None:
            self.h = replace(self.h, shift=inside(data, self.h.shift))
        self.noise = best.noise.towards(step.noise, part)
        self.track = best.track + step.track if self.moving else best.track


def refine(
    predictor: Predictor,
    starts: Sequence[Fitted | tuple[Hypothesis, NoiseModel, Array]],
    *,
    iterations: int = 6,
    tick: Callable[[], None] | None = None,
    fixed_noise: bool = False,
    worth: Callable[[Fitted], float] | None = None,
    bar: float = -np.inf,
    share: float = 1.0,
) -> list[Fitted]:
    """Fit hypotheses, those of one noise structure together.

    Args:
        predictor: evaluates hypotheses on the data.
        starts: fits to continue, or (hypothesis, noise, track).
        iterations: most iterations; a fit whose likelihood no longer rises stops earlier.
        tick: called whenever a block of fits is done.
        fixed_noise: keep the noise as it is.
        worth: value of a rival; those far behind the best of their structure stop early. None: all
            continue.
        bar: the worth of the best rival that is known already.
        share: fraction of the thresholds (in nats) at which a fit ends.

    Returns:
        The fits, in the order of `starts` (without those that could not be filtered at all).
    """
    works = [
        Work(s.hypothesis, s.noise, s.track, s if s.settled else None, still=s.settled, share=share)
        if isinstance(s, Fitted)
        else Work(*s, share=share)
        for s in starts
    ]
    (L, B), n = predictor.data.time.shape, predictor.data.model.n
    alike: dict[Structure, list[int]] = {}
    for i, work in enumerate(works):
        alike.setdefault(work.noise.structure, []).append(i)
    for structure, own in alike.items():
        wide = n if structure.tau is None else 2 * n
        size, left = max(1, int(MOST_NUMBERS / (L * B * wide * wide))), iterations
        some = [works[i] for i in own]
        # a race: after each round, those that can't catch up with the best are given up
        lap = ITERATIONS_PER_ROUND if simulated(predictor.data.model) else 1
        while worth is not None and len(some) > 1 and left > lap:
            some = _after(predictor, some, (lap, fixed_noise, False), size, tick)
            _race(some, worth, bar)
            left -= lap
        some = _after(predictor, some, (left, fixed_noise, True), size, tick)
        for i, work in zip(own, some, strict=True):
            works[i] = work
    fits = [(work.best, work.still and not fixed_noise) for work in works if work.best is not None]
    return [replace(fit, settled=True) if top and not fit.settled else fit for fit, top in fits]


def _after(
    predictor: Predictor,
    works: list[Work],
    how: tuple[int, bool, bool],
    size: int,
    tick: Callable[[], None] | None,
) -> list[Work]:
    """Run some iterations of all works, in blocks of at most `size` with filters of one shape.

    `how`: number of iterations; whether the noise is fixed; whether these are the last ones.
    """
    shapes = _of_one_shape(works, predictor.data)
    blocks = [a[at : at + size] for a in shapes for at in range(0, len(a), size)]
    many, some = len(blocks), [[works[i] for i in block] for block in blocks]
    if many and simulated(predictor.data.model):
        predictor = _begun(predictor, some[0][0])
    found = each(_climb, [predictor] * many, some, [how] * many, done=tick)
    after = list(works)
    for block, part in zip(blocks, found, strict=True):
        for i, work in zip(block, part, strict=True):
            after[i] = work
    return after


def _begun(predictor: Predictor, work: Work) -> Predictor:
    """Return a predictor with the slopes at one work's point cached, shared by all others."""
    begun = predictor.following()
    sensitivities_of(begun, work.h, work.track[:-1], begun.inputs(work.h))
    return begun


def _climb(predictor: Predictor, works: list[Work], how: tuple[int, bool, bool]) -> list[Work]:
    """Run the iterations of a block of works whose filters have one shape."""
    iterations, fixed_noise, last = how
    works = [replace(work, along=predictor.following()) for work in works]
    for left in range(iterations, 0, -1):
        if moving := [work for work in works if not work.still]:
            _iterate(predictor, moving, fixed_noise, last=last and left == 1)
    return [replace(work, along=None) for work in works]


def _race(works: list[Work], worth: Callable[[Fitted], float], bar: float) -> None:
    """Give up works RIVAL_NATS behind the best after RIVAL_PROMISE times what a step promises."""
    value = [-np.inf if work.best is None else worth(work.best) for work in works]
    for work, mine in zip(works, value, strict=True):
        reach = mine + RIVAL_PROMISE * np.nan_to_num(work.hope) + RIVAL_NATS
        work.given_up = work.given_up or -np.inf < reach < max(bar, *value)


def _of_one_shape(works: list[Work], data: Data) -> list[list[int]]:
    """Group the indices of unfinished works by the number of delayed sensors in their filters."""
    groups: dict[int, list[int]] = {}
    for i, work in enumerate(works):
        if work.still or work.given_up:
            continue
        late = delays_of(work.h, data)
        groups.setdefault(0 if late is None else len(late.channel), []).append(i)
    return [groups[count] for count in sorted(groups)]


def _iterate(
    predictor: Predictor, works: list[Work], fixed_noise: bool, *, last: bool = False
) -> None:
    data = predictor.data
    B = data.time.shape[1]
    late = [delays_of(work.h, data) for work in works]
    counts = [columns_of(work.h, data) for work in works]
    width = kalman.whole(max(counts), data.model.n)
    (L, _), n, runs = data.time.shape, data.model.n, B * len(works)
    d, r = np.zeros((L, runs, n, width)), np.zeros((L + 1, runs, n, width))
    own = [slice(i * B, (i + 1) * B) for i in range(len(works))]
    for work in works:
        work.track = predictor.remembered(work.h, work.track)
    F = [
        linearise(work.along or predictor, work.h, work.track, (d[:, i], r[:, i]))[0]
        for work, i in zip(works, own, strict=True)
    ]
    systems = [
        filter_system(predictor, work.h, work.noise, work.track, jacobian)
        for work, jacobian in zip(works, F, strict=True)
    ]
    system, delayed = joined(systems)
    try:
        g = kalman.gains(system, delayed)
    except np.linalg.LinAlgError:
        if len(works) == 1:
            works[0].still = True
        else:  # one of them diverged: filter each separately
            for work in works:
                _iterate(predictor, [work], fixed_noise, last=last)
        return
    white, filtered = kalman.innovations(g, d, r, track=True)
    assert filtered is not None
    jacobian = F[0] if len(F) == 1 else np.concatenate(F, axis=1)
    if (started := smoothed(data, g, jacobian, white[..., 0])) is not None:
        filtered[0, ..., 0] += started
    rises: dict[int, float] = {}
    for i, (work, there) in enumerate(zip(works, own, strict=True)):
        before = 0.0
        if (delays := late[i]) is not None:
            entry, residual = systems[i][0].G, white[:, there, :, 0]
            before = delays.before(work.noise, entry, work.track, residual, g.weight[:, there])
        columns, error = white[:, there, :, : counts[i]], filtered[:, there, :, 0]
        fit = _scored(predictor, work, columns, g.logdet[:, there], error, before)
        if (rise := _rises(work, fit)) == 0:
            work.shorten(data)
        elif not (last and rise >= RISE_MAY_END):  # else it has not converged, and no step follows
            rises[i] = rise
    if not rises:
        return
    up = [works[i] for i in rises]
    steps = [(work.noise, 0.0) for work in up]
    if not fixed_noise:
        residual = white[..., 0]
        if len(up) < len(works):
            which = np.concatenate([np.arange(runs)[own[i]] for i in rises])
            g, residual = g.of_runs(which), residual[:, which]
        of_up = [late[i] for i in rises], [systems[i] for i in rises]
        steps = _climbed(data, up, *of_up, g, residual)
    for i, work, step in zip(rises, up, steps, strict=True):
        assert work.best is not None
        work.step = proposed(data, work.best, filtered[:, own[i]], *step)
        little = rises[i] < RISE_MAY_END and work.step.promise < PROMISE_LAST * work.share
        work.still = work.still or little
        work.go(data)


def _climbed(
    data: Data,
    works: list[Work],
    delays_each: list[Delays | None],
    systems: list[tuple[LinearSystem, Delayed | None]],
    g: kalman.Gains,
    white: Array,
) -> list[tuple[NoiseModel, float]]:
    """Return each work's noise after one scoring step, and the expected gain [nats]."""
    B, width = data.time.shape[1], data.model.n
    adjoints = kalman.smoother(g, white).parts(B)
    K = width * (2 if works[0].noise.structure.tau is None else 3)
    L, runs, _ = white.shape
    d, r = (np.zeros((T, runs, width, kalman.whole(K, width))) for T in (L, L + 1))
    each_own = zip(works, delays_each, systems, adjoints, strict=True)
    for i, (work, delays, (own, _), adjoint) in enumerate(each_own):
        noise = work.noise if delays is None else delays.noise(work.noise)
        there = slice(i * B, (i + 1) * B)
        working(noise, adjoint, own.G, data.dt, (d[:, there], r[:, there]))
    columns = kalman.innovations(g, d, r)[0]
    phi = works[0].noise.structure.phi(data.dt)
    starts = None if g.delayed is not None else started(g, white, phi)
    found = []
    for i, (work, delays, adjoint) in enumerate(zip(works, delays_each, adjoints, strict=True)):
        info = average(columns[:, i * B : (i + 1) * B])[:K, :K]
        in_log = adjoint if delays is None else delays.restored(adjoint)
        begun = None if starts is None else starts[i * B : (i + 1) * B]
        slope = likelihood_slopes(work.noise, in_log, data.dt, begun)
        noise = climbed(work.noise, slope, info, int(data.valid.sum()))
        pairs = zip(slope, noise.logs, work.noise.logs, strict=False)
        found.append((noise, 0.5 * sum(float(s @ (a - b)) for s, a, b in pairs)))
    return found


def clean(predictor: Predictor, fit: Fitted, rounds: int = 8) -> Fitted:
    """Return the fit of the same hypothesis with outliers weighted down, its noise refitted."""
    work = Work(fit.hypothesis, fit.noise, fit.track)
    for _ in range(rounds):
        if not np.isfinite(work.track).all():
            return fit
        work.track = predictor.remembered(work.h, work.track)
        F, d, r = linearise(predictor, work.h, work.track)
        try:
            g = gains_of(predictor, work.h, work.noise, work.track, F)
        except np.linalg.LinAlgError:
            return fit
        white, filtered = kalman.innovations(g, d[..., :1], r[..., :1], track=True)
        assert filtered is not None
        started = smoothed(predictor.data, g, F, white[..., 0])
        if started is not None:
            filtered[0, ..., 0] += started
        adjoint, delays = kalman.smoother(g, white[..., 0]), delays_of(work.h, predictor.data)
        work.noise = cleaned(work.noise, adjoint if delays is None else delays.restored(adjoint))
        work.track = work.track + filtered[..., 0]
        if not all(np.isfinite(a).all() for a in (work.track, work.noise.log_q, work.noise.log_r)):
            return fit
    found = refine(predictor, [(work.h, work.noise, work.track)], iterations=4)
    return found[0] if found else fit


def _rises(work: Work, fit: Fitted) -> float:
    """Return the rise over the best point so far, 0.0 for none; keep the point if it rose."""
    rise = np.inf if work.best is None else fit.peak - work.best.peak
    if not (rise > 0 and np.isfinite(fit.evidence) and np.isfinite(fit.gram).all()):
        return 0.0
    work.still = not rise > RISE_ENDS * work.share
    work.moving = work.moving or rise > 1.0
    work.part = min(1.0, 2 * work.part)
    work.best = fit
    return float(rise)


def _scored(
    predictor: Predictor,
    work: Work,
    white: Array,
    logdet: Array,
    error: Array,
    before: float,
) -> Fitted:
    """Return a fit for the current point, from its whitened columns (residual first)."""
    data, h = predictor.data, work.h
    residual, (L, B, n, C) = white[..., 0], white[..., 1:].shape
    by_run = np.ascontiguousarray(white.swapaxes(0, 1)).reshape(B, L * n, 1 + C)
    products = by_run.swapaxes(1, 2) @ by_run
    gram, score, rss = products[:, 1:, 1:].copy(), products[:, 1:, 0].copy(), products[:, 0, 0]
    run_logdet = logdet.sum(axis=0)
    count = data.seen[1:].sum()
    loglik = -0.5 * float(rss.sum() + run_logdet.sum() + count * np.log(2 * np.pi)) + before
    peak = evidence = loglik
    k = len(h.theta)
    if k < C:
        precision = shift_precision(h, C - k)
        which = calibrated(data)
        shift = 0.0 if h.shift is None else h.shift[which] / data.model.spreads[which]
        G = gram.sum(axis=0)[k:, k:] / np.sqrt(np.outer(precision, precision))
        peak -= 0.5 * float(np.sum(precision * np.square(shift)))
        evidence = peak - 0.5 * float(np.linalg.slogdet(np.eye(C - k) + G)[1])
    return Fitted(
        hypothesis=h,
        noise=work.noise,
        track=work.track,
        loglik=loglik,
        peak=peak,
        evidence=evidence,
        gram=gram,
        score=score,
        rss=rss.copy(),
        logdet=run_logdet,
        white=residual.copy(),  # a view would keep all columns in memory
        states=work.track + error,
    )
