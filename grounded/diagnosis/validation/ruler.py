"""The ruler: rms errors of held-out open-loop predictions, in the unit of each channel.

From many moments of the log, and from the start of each trial, a hypothesis is simulated with the
recorded commands and without further measurements. Its errors are taken 0.1, 0.5 and 1 s later (of
a slow process 1, 5 and 10 steps later) and over whole trials. Its values come from the other
trials, or from the other pieces of one long log. The errors do not depend on the noise that a
diagnosis estimates, so they can be compared between hypotheses, models and diagnoses. Two
hypotheses are compared by `gain`.

Of a log that is late, no value counts that the start has used (`unseen`): the first new one does.

No model predicts better than the noise floor. If a manoeuvre was repeated (same candidate or same
commands), predictions of the repeats share the model's error and differ in noise, so the scatter
among their errors is the floor. Otherwise the one-step residual is taken as white noise and
propagated by the model to each horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.levels import ALIKE, SHARE, WILD
from grounded.diagnosis.likelihood.carried import stepper
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.delays import delays_of
from grounded.diagnosis.likelihood.fitted import Fitted, leave_one_out, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.marching import marched
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.validation.choose import Comparison, Errors, Gain, jackknife
from grounded.frozen import Array
from grounded.task import Task
from grounded.trial import Trial

SECONDS = (0.1, 0.5, 1.0)
SLOW_DT_S, STEPS = (
    0.5,
    (1, 5, 10),
)  # [s] control step from which a process counts as slow; its horizons
MOST_STARTS, FEWER_STARTS = 400, 75  # the second applies to a simulator, whose steps are slow
MOST_WHOLE = 8  # most trials that are predicted from start to end
WHOLE_STEPS = 4000  # most steps of these together, unless that leaves fewer than LEAST_WHOLE
LEAST_WHOLE = 3
FINE = 2e-3  # fraction of a channel's spread below which errors are negligible,
SLIGHT_ERROR = 1e-2  # and the same fraction of the crude model's error, or of the spread if smaller
MOMENTS = 20  # most moments at which repeats are compared


class Ruler:
    """Held-out errors of fitted hypotheses on one set of trials."""

    def __init__(self, predictor: Predictor, origin: Task | None = None) -> None:
        self.predictor, self.data, self.origin = predictor, predictor.data, origin
        data = self.data
        self.held_out = len(np.unique(data.folds)) > 1
        longest = int(data.lengths.max())
        fast = data.dt < SLOW_DT_S
        steps = (1, *(max(1, round(s / data.dt)) for s in SECONDS)) if fast else STEPS
        self.steps = tuple(dict.fromkeys(k for k in steps if k < longest))  # and the whole trial
        self.names = [n for i, n in enumerate(data.model.state_names) if i not in data.hidden]
        self.shown = [data.model.state_names.index(n) for n in self.names]
        self.state0 = np.cumsum([0, *(data.lengths + 1)])[:-1]  # of each trial, flat
        self.step0 = np.cumsum([0, *data.lengths])[:-1]
        count = -(-data.valid.sum(axis=1).astype(int) // self.steps[-1])
        self.piece0 = np.cumsum([0, *np.maximum(count, 1)])  # first piece of each run, and the end
        self.run_of: Any = np.repeat(np.arange(len(count)), np.diff(self.piece0))
        # the runs of a trial count as one; in a single log, each for itself
        trial = np.unique(data.trial_of, return_inverse=True)[1]
        self.unit: Any = (trial if trial.any() else np.arange(len(count)))[self.run_of]
        self.fine_whole = self.fine  # over whole trials
        self._measured: dict[int, tuple[Fitted, Errors]] = {}
        self._compared: dict[tuple[int, int], Gain] = {}

    @cached_property
    def starts(self) -> tuple[Any, Any]:
        """Step within the run, and run, of each moment that predictions start from, (M,) each."""
        data, least = self.data, self.steps[0]
        lengths = data.valid.sum(axis=1).astype(int)
        first = data.step_at[:, 0] - self.step0[data.trial_of]
        room = data.lengths[data.trial_of] - least - first
        begin = data.begin
        pairs = [
            (t, b)
            for b in range(len(lengths))
            for t in range(begin[b], min(lengths[b], room[b] + 1))
        ] or [(0, 0)]
        most = MOST_STARTS if not simulated(data.model) else FEWER_STARTS
        at, run = np.array(pairs[:: max(1, len(pairs) // most)]).T
        return at, run

    @cached_property
    def wholes(self) -> Any:
        """The first runs of the trials that are predicted from start to end."""
        data = self.data
        first = np.flatnonzero(data.step_at[:, 0] == self.step0[data.trial_of])
        most = int(np.clip(WHOLE_STEPS // data.lengths.max(), LEAST_WHOLE, MOST_WHOLE))
        return first[np.unique(np.linspace(0, len(first) - 1, most).astype(int))]

    @cached_property
    def fine(self) -> Array:
        """Error of each state below which differences are negligible, (n,)."""
        return np.asarray(np.maximum(FINE * self.data.filled.std(axis=0), 1e-12))

    def beside(self, crude: Fitted) -> None:
        """Set negligible errors relative to those of the crude model at the outset."""
        self.outset = self.errors(crude) if self.origin is None else self._origin(crude)
        missed, spread = np.nan_to_num(self.outset.rms), self.data.filled.std(axis=0)
        self.fine_whole = np.maximum(
            self.fine, SLIGHT_ERROR * np.minimum(missed.max(axis=0), spread)
        )
        self.fine = np.maximum(
            self.fine, SLIGHT_ERROR * np.minimum(missed[:-1].max(axis=0), spread)
        )
        self._compared.clear()

    def since_outset(self, fit: Fitted) -> float:
        """Return the mean gain of a hypothesis over the model before anything was adopted."""
        return self.compared(self.outset, self.errors(fit)).mean

    def _origin(self, crude: Fitted) -> Errors:
        """Return errors of the model before effects were adopted; its states are the first n."""
        assert self.origin is not None
        model, n = self.origin.model, self.origin.model.n
        states, latency = self.data.states[:, :n], self.origin.latency
        latency = np.zeros(model.m) if latency is None else latency
        data = replace(self.data, model=model, states=states, latency=latency, hidden=())
        bare = replace(crude, hypothesis=Hypothesis(), states=crude.states[..., :n])
        found = Ruler(Predictor(data)).errors(bare)
        more = [(0, 0), (0, 0), (0, self.data.model.n - n)]
        return Errors(np.pad(found.total, more), np.pad(found.count, more))

    @property
    def measured(self) -> list[tuple[Fitted, Errors]]:
        """All fits measured so far, with their errors."""
        return list(self._measured.values())

    def errors(self, fit: Fitted) -> Errors:
        """Return the held-out errors of a hypothesis, starting from its own filtered states."""
        if id(fit) not in self._measured:
            self._measured[id(fit)] = fit, self._errors(fit)
        return self._measured[id(fit)][1]

    def _errors(self, fit: Fitted) -> Errors:
        found = self._none()
        each, of_run = by_fold(self.data, fit)
        self._add(found, each, of_run, fit.states, unseen(self.predictor, fit.hypothesis))
        return found

    def _none(self) -> Errors:
        shape = len(self.steps) + 1, len(self.run_of), self.data.model.n
        return Errors(np.zeros(shape), np.zeros(shape))

    def _add(
        self,
        found: Errors,
        each: Sequence[Hypothesis],
        of_run: Any,
        track: Array,
        first: Any,
        added: Array | None = None,
        whole: bool = True,
    ) -> None:
        """Add the errors of all runs, each with its hypothesis, to `found`.

        `first` (n,): steps after which a log shows what the track has not used (`unseen`). `added`
        (L, B, n) is added to every step within a run.
        """
        # the long ones first: what is compiled for them is at hand for the others
        lengths = self.data.lengths[self.data.trial_of[self.wholes]]
        for steps in np.unique(lengths) if whole else ():
            run = self.wholes[lengths == steps]
            error = self._missed(each, of_run, track, np.zeros(len(run), int), run, int(steps))
            square = error[1:] ** 2
            found.total[-1, self.piece0[run]] += np.nan_to_num(square).sum(axis=0)
            found.count[-1, self.piece0[run]] += np.isfinite(square).sum(axis=0)
        at, run = self.starts
        piece = self.piece0[run] + (at - 1) // self.steps[-1]
        most = max(self.steps[-1], int(first.max()))
        error = self._missed(each, of_run, track, at, run, most, added)
        for k, steps in enumerate(self.steps):
            square = at_steps(error, steps, first) ** 2
            np.add.at(found.total[k], piece, np.nan_to_num(square))
            np.add.at(found.count[k], piece, np.isfinite(square))

    def _missed(
        self,
        each: Sequence[Hypothesis],
        of_run: Any,
        track: Array,
        at: Any,
        run: Any,
        steps: int,
        added: Array | None = None,
    ) -> Array:
        """Return what is `missed` if each run is predicted by its own hypothesis."""
        error = np.empty((steps + 1, len(at), self.data.model.n))
        for i in np.unique(of_run[run]):
            own = of_run[run] == i
            error[:, own] = missed(self.predictor, each[i], track, at[own], run[own], steps, added)
        return error

    def doubt(self, fit: Fitted) -> Array:
        """Return the jackknife standard error of each log rms error, over runs, (K, n')."""
        found = self.errors(fit)
        total, count = (self.by_run(a[..., self.shown]) for a in (found.total, found.count))
        left = [a.sum(axis=1, keepdims=True) - a for a in (total, count)]
        each = 0.5 * np.log(np.maximum(left[0], 1e-300) / np.maximum(left[1], 1))
        return jackknife(np.moveaxis(each, 1, 0))

    def gain(self, before: Fitted, after: Fitted) -> Gain:
        """Return the gain of `after` over `before`."""
        return self.compared(self.errors(before), self.errors(after))

    def corrected(self, fit: Fitted, channel: str, rate: Array) -> tuple[Gain, Errors]:
        """Return the gain of adding a rate (L, B) to a state along the log, and the new errors."""
        step = np.zeros((*rate.shape, self.data.model.n))
        step[..., self.data.model.state_names.index(channel)] = rate * self.data.dt
        plain, other, of_run = self._none(), self._none(), np.zeros(len(self.data.valid), int)
        first = unseen(self.predictor, fit.hypothesis)
        for found, added in ((plain, None), (other, step)):
            self._add(found, [fit.hypothesis], of_run, fit.states, first, added, whole=False)
        return self.compared(plain, other), other

    def compared(self, before: Errors, after: Errors) -> Gain:
        """Return the gain of one set of errors over another."""
        known = self._compared.get((id(before), id(after)))
        if known is None:
            known = self.comparison(before, after)
            self._compared[id(before), id(after)] = known
        return known

    @property
    def comparison(self) -> Comparison:
        """How errors are compared."""
        return Comparison(self.shown, self._matters(), self.unit)

    def _matters(self) -> Array:
        """Return the error below which differences are negligible, (K, n')."""
        short, whole = self.fine[self.shown], self.fine_whole[self.shown]
        return np.stack([*[short] * len(self.steps), whole])

    def score(self, fit: Fitted) -> float:
        """Return the log score of a hypothesis: minus the mean log of errors, by spread."""
        rms = np.hypot(self.errors(fit).rms[:, self.shown], self._matters())
        spread = np.maximum(self.data.filled.std(axis=0)[self.shown], 1e-300)
        logs = np.log(rms / spread)
        return -float(np.mean(logs[np.isfinite(logs)])) if np.isfinite(logs).any() else 0.0

    @property
    def by(self) -> str:
        """What is held out: groups of trials, trials, pieces of a single log, or nothing."""
        if not self.held_out:
            return "no"
        several = "groups" if len(self.data.groups) > 1 else "trials"
        return several if self.data.count > 1 else "pieces"

    def by_run(self, pieces: Array) -> Array:
        """Return the sums of pieces (K, P, n) by run (K, B, n)."""
        return np.asarray(np.add.reduceat(pieces, self.piece0[:-1], axis=1))

    # -- the floor ----------------------------------------------------------------------------

    def scatter(self, fit: Fitted, repeats: Sequence[Sequence[int]]) -> tuple[Array, Array] | None:
        """Return the noise floor from repeats: the scatter of their errors about their mean.

        The number of independent samples is the number of repeats times the number of horizons that
        fit into one: two repeats of 4 s sample the noise over a second about eight times. If it is
        larger in some motions than in others (on an unstable ball), they tell less: then what
        counts is how much it differs from moment to moment. Noise is never less further ahead.

        Returns:
            The rms floor (K, n), NaN for whole trials if these are longer than the repeats, and the
            standard deviation of its logarithm (K,). None without repeats.
        """
        data, h, K = self.data, fit.hypothesis, len(self.steps)
        first = unseen(self.predictor, h)
        starts = np.flatnonzero(data.step_at[:, 0] == self.step0[data.trial_of])
        of_trial = dict(zip(data.trial_of[starts].tolist(), starts.tolist(), strict=True))
        longest = int(data.lengths[data.trial_of[self.wholes]].max())
        total, count = np.zeros((2, K + 1, data.model.n))
        powers = np.zeros((3, K + 1, data.model.n))  # of variances, over independent moments
        often = np.zeros(K + 1)
        for group in repeats:
            runs = self._alike(fit, np.array([of_trial[i] for i in group if i in of_trial], int))
            if len(runs) < 2:
                continue
            length = int(data.lengths[data.trial_of[runs]].min())
            used = int(data.valid[runs].sum(axis=1).min())
            for k, steps in enumerate((*self.steps, length)):
                whole, last = k == K, min(used - 1, length - steps)
                if last < 0 or (whole and longest > (1 + ALIKE) * length):
                    continue  # what is used of the runs is shorter than this horizon
                begin = min(int(self.starts[0].min()), last)
                several = np.unique(np.linspace(begin, last, MOMENTS).astype(int))
                moments = np.zeros(1, int) if whole else several
                at, run = np.tile(moments, len(runs)), np.repeat(runs, len(moments))
                most = steps if whole else max(steps, int(first.max()))
                error = missed(self.predictor, h, fit.states, at, run, most)
                error = error[1:] if whole else at_steps(error, steps, first)[None]
                error = error.reshape(len(error), len(runs), len(moments), -1)
                there = np.isfinite(error).all(axis=1)
                spread = np.where(there, np.nan_to_num(error).var(axis=1, ddof=1), 0.0)
                total[k] += spread.sum(axis=(0, 1))
                count[k] += there.sum(axis=(0, 1))
                apart = min(max(length // steps, 1) / len(moments), 1.0) * (not whole)
                powers[:, k] += apart * np.stack([there, spread, spread**2]).sum(axis=(1, 2))
                often[k] += (len(runs) - 1) * np.clip(length // steps, 1, MOMENTS)
        watched = [i for i in self.shown if data.seen[..., i].any()]
        if not (count[:-1][:, watched] > 0).all():
            return None
        found = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        found[:-1] = np.fmax.accumulate(found[:-1], axis=0)
        # how much the variance differs from moment to moment, as an error of its root's logarithm
        alone, own, square = powers[..., watched]
        mean = own / np.maximum(alone, 1e-12)
        uneven = np.maximum(square - own * mean, 0.0) / np.maximum((alone - 1) * alone, 1e-12)
        uneven = np.where((alone > 1) & (mean > 0), np.sqrt(uneven) / (2 * mean + 1e-300), 0.0)
        return found, np.maximum(1 / np.sqrt(2 * np.maximum(often, 0.5)), uneven.max(axis=1))

    def _alike(self, fit: Fitted, runs: Any) -> Any:
        """Return the runs that are repeats, without those whose one-step errors are far larger.

        The errors of true repeats differ by noise only, so none can be far above the smallest.
        """
        found = self.errors(fit)
        total, count = (self.by_run(a)[0][runs][:, self.shown] for a in (found.total, found.count))
        each = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        least = np.fmin.reduce(each, axis=0, initial=np.inf) + self.fine[self.shown]
        return runs[~(each > WILD * least).any(axis=1)]


def repeated(trials: Sequence[Trial], data: Data, first: int) -> list[list[int]]:
    """Return groups of trials, as indices, with the same candidate or nearly the same commands.

    Args:
        trials: the trials of the data, in its order.
        data: the data prepared from them.
        first: number of trials in the first group of a comparison. Trials of two groups are not
            repeats of each other, as the robot may have changed between them.
    """
    groups: list[list[int]] = []
    scale = np.maximum(
        np.std(np.concatenate([t.inputs[: t.known_steps] for t in trials]), axis=0), 1e-12
    )
    for i, trial in enumerate(trials):
        for group in groups:
            if (group[0] < first) != (i < first):
                continue
            one = trials[group[0]]
            if trial.candidate and trial.candidate == one.candidate:
                group.append(i)
                break
            length = min(int(data.lengths[i]), int(data.lengths[group[0]]))
            apart = (trial.inputs[:length] - one.inputs[:length]) / scale
            same = abs(int(data.lengths[i]) - int(data.lengths[group[0]])) <= ALIKE * length
            if same and np.sqrt((apart**2).mean(axis=0)).max() < SHARE:
                group.append(i)
                break
        else:
            groups.append([i])
    return [group for group in groups if len(group) > 1]


LED = 400  # steps of predictions from which how inputs change within a step is left out
DIVERGED = 1e6  # size of a state above which it has diverged


def by_fold(data: Data, fit: Fitted) -> tuple[list[Hypothesis], Any]:
    """Return a fit's hypothesis for each fold, with values from the others; the fold of each run.

    Without values, or a second fold, it is one hypothesis for all runs.
    """
    h, (folds, of_run) = fit.hypothesis, np.unique(data.folds, return_inverse=True)
    if len(folds) < 2 or not (h.effects or h.spread > 0):
        return [h], np.zeros_like(of_run)
    shifts = leave_one_out(fit, data.folds)
    return [moved(data, h, shift) for shift in shifts], of_run


def missed(
    predictor: Predictor,
    h: Hypothesis,
    track: Array,
    at: Any,
    run: Any,
    steps: int,
    added: Array | None = None,
) -> Array:
    """Return measurement minus prediction, 0 to `steps` steps after each of M moments.

    Args:
        predictor: evaluates hypotheses on the data.
        h: the hypothesis that predicts.
        track: states from which predictions start, (L + 1, B, n).
        at: step within the run of each moment, (M,) of int.
        run: run of each moment, (M,) of int.
        steps: number of steps ahead.
        added: added to every step within a run, (L, B, n).

    Returns:
        Errors (steps + 1, M, n), NaN where not measured.
    """
    data, n = predictor.data, predictor.data.model.n
    trial = data.trial_of[run]
    state0, step0 = (np.cumsum([0, *(data.lengths + more)])[trial] for more in (1, 0))
    step, last = data.step_at[run, 0] - step0 + at, data.lengths[trial]
    t = np.minimum(step + np.arange(steps)[:, None], last - 1)
    sent = predictor.received(h, leads=steps < LED)[trial, t]
    delays = delays_of(h, data)  # sensors may show states from before the start
    oldest = 0 if delays is None else delays.oldest
    path = [track[np.maximum(at - j, 0), run] for j in range(oldest, -1, -1)]

    # the states, with the memories of joints behind them
    end = len(data.time) - 1
    x = predictor.widened(h, track[: end + 1])[np.minimum(at, end), run]
    x[:, :n] = track[at, run]
    done = None if added is not None else _marched(predictor, h, x, sent, t[0] * data.dt)
    if done is not None:
        path, sent = [*path, *done[1:, :, :n]], sent[:0]  # all steps are done
    advance = stepper(predictor, h)
    for j, (u, now) in enumerate(zip(sent, t[: len(sent)] * data.dt, strict=True)):
        x = advance(x, u, now)
        if added is not None:
            inside = (at + j < len(added))[:, None]
            x[:, :n] += np.where(inside, added[np.minimum(at + j, len(added) - 1), run], 0.0)
        x = np.fmax(np.fmin(x, DIVERGED), -DIVERGED)  # NaN becomes DIVERGED, too
        path.append(x[:, :n])
    states = np.stack(path)
    logged = (states + predictor.offset(h, states))[oldest:]
    ahead = step + np.arange(steps + 1)[:, None]
    flat = state0 + np.minimum(ahead, last)
    error = data.model.difference(data.filled[flat], logged)
    seen = np.isfinite(data.states[flat]) & (ahead <= last)[..., None]
    return np.where(seen, error, np.nan)


def unseen(predictor: Predictor, h: Hypothesis) -> Any:
    """Return how many steps after a moment each log first shows what the start there has not used.

    (n,) of int. A filter uses a log that is late by k whole steps with the state that it shows. So
    the log of k steps later is no prediction from there, but a part of the start.
    """
    found, delays = np.ones(predictor.data.model.n, int), delays_of(h, predictor.data)
    if delays is not None:
        found[list(delays.channel)] += np.array(delays.whole)
    return found


def at_steps(error: Array, steps: int, first: Any) -> Array:
    """Return errors (S, M, n) after some steps, of late logs not before `first` (n,), (M, n)."""
    at = np.maximum(steps, first)
    return np.asarray(error[at, :, np.arange(len(at))].T)


def _marched(predictor: Predictor, h: Hypothesis, x: Array, sent: Array, t: Array) -> Array | None:
    """Return compiled rollouts (steps + 1, M, n); None if not compiled, or one diverges.

    x (M, n), sent (steps, M, m or 2 m), t (M,): states, received inputs and times at the start.
    """
    z = predictor.marched(h, x, sent)
    if z is None:
        z = marched(predictor, h, x, sent, t)
    elif not (np.abs(z) < DIVERGED).all():
        return None
    return None if z is None else np.fmax(np.fmin(z, DIVERGED), -DIVERGED)
