"""The ruler: how wrong held-out open-loop predictions are, in the units of each channel.

From many moments of the log, and from the beginning of each trial, a hypothesis runs on with the
commands that were sent and sees nothing more of the log. Its errors 0.1, 0.5 and 1 s later, and
over whole trials, are what an engineer would measure; values come from the other trials, or from
the other pieces of one long log. The noise that a diagnosis estimates has no part in them, so they
compare between hypotheses, models and days.

Two hypotheses are compared by what one gains (`gain`).

No model predicts better than the noise floor. Where a manoeuvre was repeated, by a candidate or by
commands that are the same, predictions of the repeats miss by the same model error and by different
noise: the scatter among them is the floor. Else it comes from the short horizon: what one step
leaves, as white noise, carried on by the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.fitted import Fitted, leave_one_out, moved
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.validation.ahead import missed
from grounded.diagnosis.validation.gain import Errors, Gain
from grounded.frozen import Array
from grounded.task import Task
from grounded.trial import Trial

SECONDS = (0.1, 0.5, 1.0)
MOST_STARTS, FEWER_STARTS = 400, 75  # the fewer of a simulator, whose steps are slow
MOST_WHOLE = 8  # trials that are predicted from beginning to end
WHOLE_STEPS = 4000  # of them together, where that leaves LEAST_WHOLE
LEAST_WHOLE = 3
FINE = 2e-3  # of a channel's spread: errors below it do not matter
SLIGHT = 1e-2  # nor below this part of the crude model's, or of the spread where that is less
ODD = 10.0  # times the error of the best repeat: a trial that misses more is none
MOMENTS = 20  # at which repeats are compared
AS_LONG = 1.25  # times as long as repeats: whole trials that their scatter says something of
ALIKE = 0.02  # of a command's spread: how much commands of repeats may differ, rms


MOST_LEFT_OUT = 1 / 3  # of all steps: without more, the rest would have to extrapolate
MOST_FOLDS = 20


def folds(data: Data) -> Any:
    """What each run is held out with, (B,): its trial; of one that holds most, piece by piece.

    Of very many trials several together: the rest tells as much without them.
    """
    share = data.lengths[data.trial_of] / data.lengths.sum()
    whole = data.trial_of * min(data.count, MOST_FOLDS) // data.count
    return np.where(share > MOST_LEFT_OUT, data.count + np.arange(len(share)), whole)


class Ruler:
    """Errors of fitted hypotheses on one set of trials."""

    def __init__(self, predictor: Predictor, origin: Task | None = None) -> None:
        self.predictor, self.data, self.origin = predictor, predictor.data, origin
        data = self.data
        self.folds = folds(data)
        self.held_out = len(np.unique(self.folds)) > 1
        longest = int(data.lengths.max())
        steps = (1, *(max(1, round(s / data.dt)) for s in SECONDS))
        self.steps = tuple(dict.fromkeys(k for k in steps if k < longest))  # and the whole trial
        self.names = [n for i, n in enumerate(data.model.state_names) if i not in data.hidden]
        self.shown = [data.model.state_names.index(n) for n in self.names]
        self.state0 = np.cumsum([0, *(data.lengths + 1)])[:-1]  # of each trial, flat
        self.step0 = np.cumsum([0, *data.lengths])[:-1]
        count = -(-data.valid.sum(axis=1).astype(int) // self.steps[-1])
        self.piece0 = np.cumsum([0, *np.maximum(count, 1)])  # the first of each run, and the end
        self.run_of = np.repeat(np.arange(len(count)), np.diff(self.piece0))
        self.fine_whole = self.fine  # over whole trials
        self._measured: dict[int, tuple[Fitted, Errors]] = {}

    @cached_property
    def starts(self) -> tuple[Any, Any]:
        """(step within the run, run) of each moment that is predicted from, (M,) each."""
        data, least = self.data, self.steps[0]
        lengths = data.valid.sum(axis=1).astype(int)
        first = data.step_at[:, 0] - self.step0[data.trial_of]
        room = data.lengths[data.trial_of] - least - first
        pairs = [
            (t, b) for b in range(len(lengths)) for t in range(1, min(lengths[b], room[b] + 1))
        ] or [(0, 0)]
        most = MOST_STARTS if not simulated(data.model) else FEWER_STARTS
        at, run = np.array(pairs[:: max(1, len(pairs) // most)]).T
        return at, run

    @cached_property
    def wholes(self) -> Any:
        """The first runs of the trials that are predicted whole."""
        data = self.data
        first = np.flatnonzero(data.step_at[:, 0] == self.step0[data.trial_of])
        most = int(np.clip(WHOLE_STEPS // data.lengths.max(), LEAST_WHOLE, MOST_WHOLE))
        return first[np.unique(np.linspace(0, len(first) - 1, most).astype(int))]

    @cached_property
    def fine(self) -> Array:
        """Error of each state below which nothing matters, (n,)."""
        return np.asarray(np.maximum(FINE * self.data.filled.std(axis=0), 1e-12))

    def beside(self, crude: Fitted) -> None:
        """What matters from now on is measured by what the crude model missed at the outset."""
        self.outset = self.errors(crude) if self.origin is None else self._origin(crude)
        missed, spread = np.nan_to_num(self.outset.rms), self.data.filled.std(axis=0)
        self.fine_whole = np.maximum(self.fine, SLIGHT * np.minimum(missed.max(axis=0), spread))
        self.fine = np.maximum(self.fine, SLIGHT * np.minimum(missed[:-1].max(axis=0), spread))

    def since_outset(self, fit: Fitted) -> float:
        """What a hypothesis predicts better than the model did before anything was adopted."""
        return self.compared(self.outset, self.errors(fit)).mean

    def _origin(self, crude: Fitted) -> Errors:
        """Errors of the model before effects were adopted, whose states are the first of these."""
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
        """All hypotheses that were measured so far."""
        return list(self._measured.values())

    def errors(self, fit: Fitted) -> Errors:
        """Held-out errors of a hypothesis, from its own filtered states."""
        if id(fit) not in self._measured:
            self._measured[id(fit)] = fit, self._errors(fit)
        return self._measured[id(fit)][1]

    def _errors(self, fit: Fitted) -> Errors:
        data, h, found = self.data, fit.hypothesis, self._none()
        each, of_run = [h], np.zeros(len(data.valid), int)
        if self.held_out and (h.effects or h.spread > 0):
            shifts, _ = leave_one_out(fit, self.folds)
            each = [moved(data, h, shift) for shift in shifts]
            of_run = np.unique(self.folds, return_inverse=True)[1]
        self._add(found, each, of_run, fit.states)
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
        added: Array | None = None,
        whole: bool = True,
    ) -> None:
        """The errors of all runs, each of its hypothesis; `added` to every step within a run."""
        at, run = self.starts
        piece = self.piece0[run] + (at - 1) // self.steps[-1]
        error = missed(self.predictor, each, of_run[run], track, at, run, self.steps[-1], added)
        for k, steps in enumerate(self.steps):
            square = error[steps] ** 2
            np.add.at(found.total[k], piece, np.nan_to_num(square))
            np.add.at(found.count[k], piece, np.isfinite(square))
        lengths = self.data.lengths[self.data.trial_of[self.wholes]]
        for steps in np.unique(lengths) if whole else ():
            run = self.wholes[lengths == steps]
            error = missed(
                self.predictor, each, of_run[run], track, np.zeros(len(run), int), run, int(steps)
            )
            square = error[1:] ** 2
            found.total[-1, self.piece0[run]] += np.nan_to_num(square).sum(axis=0)
            found.count[-1, self.piece0[run]] += np.isfinite(square).sum(axis=0)

    def doubt(self, fit: Fitted) -> Array:
        """Scatter of the logarithm of each rms error, the jackknife's over runs, (K, n')."""
        found = self.errors(fit)
        total, count = (self.by_run(a[..., self.shown]) for a in (found.total, found.count))
        left = [a.sum(axis=1, keepdims=True) - a for a in (total, count)]
        each = 0.5 * np.log(np.maximum(left[0], 1e-300) / np.maximum(left[1], 1))
        B = each.shape[1]
        return np.asarray(np.sqrt((B - 1) * each.var(axis=1) if B > 1 else each[:, 0] * 0 + np.inf))

    def gain(self, before: Fitted, after: Fitted) -> Gain:
        """What `after` predicts better than `before`."""
        return self.compared(self.errors(before), self.errors(after))

    def corrected(self, fit: Fitted, rate: Array) -> tuple[Gain, Errors]:
        """What a fit would gain by a rate (L, B, n) [unit/s] added along its log; its errors."""
        plain, other, of_run = self._none(), self._none(), np.zeros(len(self.data.valid), int)
        for found, added in ((plain, None), (other, rate * self.data.dt)):
            self._add(found, [fit.hypothesis], of_run, fit.states, added, whole=False)
        return self.compared(plain, other), other

    def compared(self, before: Errors, after: Errors) -> Gain:
        """The same of errors."""
        a, b = (errors.total[..., self.shown] for errors in (before, after))
        count = before.count[..., self.shown].sum(axis=1, keepdims=True)
        seen, least = count > 0, count * self._matters()[:, None] ** 2 + 1e-300

        def ratio(x: Array, y: Array) -> Array:
            return np.asarray(np.where(seen, 0.5 * np.log((x + least) / (y + least)), 0.0))

        def without(x: Array) -> Array:
            return np.asarray(np.maximum(x.sum(axis=1, keepdims=True) - x, 0.0))

        whole = ratio(a.sum(axis=1, keepdims=True), b.sum(axis=1, keepdims=True))
        counts = np.maximum(seen.sum(axis=(0, 1)), 1)
        by = ratio(without(self.by_run(a)), without(self.by_run(b))).sum(axis=0)
        each = by.sum(axis=-1) / max(int(seen.sum()), 1)
        return Gain(
            float(whole.sum() / max(int(seen.sum()), 1)),
            float(_jackknife(each)),
            float(whole.max()),
            whole.sum(axis=(0, 1)) / counts,
            _jackknife(by / counts),
            self._pieces(before, after),
            self.data.trial_of[self.run_of],
            self._by_trial(before, after),
        )

    def _matters(self) -> Array:
        """Error below which nothing matters, by horizon and shown state, (K, n')."""
        short, whole = self.fine[self.shown], self.fine_whole[self.shown]
        return np.stack([*[short] * len(self.steps), whole])

    def _pieces(self, before: Errors, after: Errors) -> Array:
        """What each piece gains (P,), beside what `after` misses on average: no piece rules."""
        a, b, n = (e[:-1][..., self.shown] for e in (before.total, after.total, before.count))
        all_n = np.maximum(n.sum(axis=1, keepdims=True), 1)
        usual = n * (b.sum(axis=1, keepdims=True) / all_n + self.fine[self.shown] ** 2) + 1e-300
        return np.asarray((n / all_n * np.log((a + usual) / (b + usual))).sum(axis=(0, 2)))

    def _by_trial(self, before: Errors, after: Errors) -> Array:
        """What each trial gains by itself, the mean over channels and horizons, (S,)."""
        trials = [self.data.trial_of == i for i in self.data.used]
        runs = [self.by_run(e[..., self.shown]) for e in (before.total, after.total, before.count)]
        a, b, n = (np.stack([e[:, own].sum(axis=1) for own in trials]) for e in runs)
        least, seen = n * self._matters() ** 2 + 1e-300, n > 0
        each = np.where(seen, 0.5 * np.log((a + least) / (b + least)), 0.0)
        return np.asarray(each.sum(axis=(1, 2)) / np.maximum(seen.sum(axis=(1, 2)), 1))

    def by_run(self, pieces: Array) -> Array:
        """Sums of pieces (K, P, n) by run (K, B, n)."""
        return np.asarray(np.add.reduceat(pieces, self.piece0[:-1], axis=1))

    # -- the floor ----------------------------------------------------------------------------

    def scatter(self, fit: Fitted, repeats: Sequence[Sequence[int]]) -> tuple[Array, Array] | None:
        """Rms error that repeats leave around their mean, (K, n), and how sure it is; None without.

        Sure to that standard deviation of its logarithm, (K,): two repeats of 4 s tell what noise
        does in a second eight times. Of whole trials they say nothing where those are longer.
        """
        data, h = self.data, fit.hypothesis
        first = np.flatnonzero(data.step_at[:, 0] == self.step0[data.trial_of])
        of_trial = dict(zip(data.trial_of[first].tolist(), first.tolist(), strict=True))
        total = np.zeros((len(self.steps) + 1, data.model.n))
        count, often = np.zeros_like(total), np.zeros(len(total))
        longest = int(data.lengths[data.trial_of[self.wholes]].max())
        for group in repeats:
            runs = np.array([of_trial[i] for i in group if i in of_trial])
            runs = self._alike(h, fit.states, runs)
            if len(runs) < 2:
                continue
            length = int(data.lengths[data.trial_of[runs]].min())
            own = int(data.valid[runs].sum(axis=1).min())
            for k, steps in enumerate((*self.steps, length)):
                if k == len(self.steps) and longest > AS_LONG * length:
                    continue
                often[k] += (len(runs) - 1) * np.clip(length // steps, 1, MOMENTS)
                last = min(own - 1, length - steps)
                moments = np.unique(np.linspace(min(1, last), last, MOMENTS).astype(int))
                moments = np.zeros(1, int) if k == len(self.steps) else moments[moments >= 0]
                at, run = np.tile(moments, len(runs)), np.repeat(runs, len(moments))
                error = missed(self.predictor, [h], 0 * at, fit.states, at, run, steps)
                error = error[1:] if k == len(self.steps) else error[-1:]
                error = error.reshape(len(error), len(runs), len(moments), -1)
                there = np.isfinite(error).all(axis=1)
                spread = np.where(there, np.nan_to_num(error).var(axis=1, ddof=1), 0.0)
                total[k] += spread.sum(axis=(0, 1))
                count[k] += there.sum(axis=(0, 1))
        if not (count[:-1][:, self._watched] > 0).all():
            return None
        found = np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
        return found, 1 / np.sqrt(2 * np.maximum(often, 0.5))

    def _alike(self, h: Hypothesis, track: Array, runs: Any) -> Any:
        """The runs that noise alone may tell apart; the rest repeat nothing.

        Their errors hold that scatter, so the best of them can't be predicted much better than it.
        """
        own = []
        for run in runs:
            at, steps = np.arange(1, int(self.data.valid[run].sum())), self.steps[0]
            at = at[:: max(1, len(at) // MOMENTS)]
            where = np.full(len(at), run)
            error = missed(self.predictor, [h], 0 * at, track, at, where, steps)[-1]
            squares = error[:, self._watched] ** 2
            count = np.isfinite(squares).sum(axis=0)
            own.append(np.where(count, np.sqrt(np.nansum(squares, axis=0) / count.clip(1)), np.nan))
        if not own:
            return runs
        least = np.fmin.reduce(own) + self.fine[self._watched]
        return runs[[not (one > ODD * least).any() for one in own]]  # what one lacks tells nothing

    @property
    def _watched(self) -> list[int]:
        """The shown states that are measured at all."""
        return [i for i in self.shown if self.data.seen[..., i].any()]


def _jackknife(each: Array) -> Array:
    """Scatter of a mean from the means without each run, (B, ...) -> (...)."""
    B = len(each)
    if B < 2:
        return np.full(each.shape[1:], np.inf)
    return np.asarray(np.sqrt((B - 1) / B * ((each - each.mean(axis=0)) ** 2).sum(axis=0)))


def repeated(trials: Sequence[Trial], data: Data) -> list[list[int]]:
    """Groups of trials that repeat a manoeuvre, as indices: of one candidate, or commanded alike.

    Args:
        trials: those of the data, in its order.
        data: prepared from them.
    """
    groups: list[list[int]] = []
    scale = np.maximum(
        np.std(np.concatenate([t.inputs[: t.known_steps] for t in trials]), axis=0), 1e-12
    )
    for i, trial in enumerate(trials):
        for group in groups:
            one = trials[group[0]]
            if trial.candidate and trial.candidate == one.candidate:
                group.append(i)
                break
            length = min(int(data.lengths[i]), int(data.lengths[group[0]]))
            apart = (trial.inputs[:length] - one.inputs[:length]) / scale
            same = abs(int(data.lengths[i]) - int(data.lengths[group[0]])) <= 0.1 * length
            if same and np.sqrt((apart**2).mean(axis=0)).max() < ALIKE:
                group.append(i)
                break
        else:
            groups.append([i])
    return [group for group in groups if len(group) > 1]
