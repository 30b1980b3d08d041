"""START HERE: the sim-to-real gap, diagnosed. Trials and a crude model in, a verdict out.

limits            what can't be known from these data; which parameters they identify
attribution       which effects, by evidence       (search, hypotheses, scan, refine, noise, fitted)
ruler             held-out prediction errors in the channels' units, and the noise floor
decide            evidence proposes, the ruler decides; what each cause is worth
claims            what is claimed, what ties, what is nearly the same    (lookalike)
leftover          what no effect explains
prediction_error  where the gap lies: channels, times, regions
split             what the error is made of: explained, unexplained, irreducible
verdict           all of it in sentences; `report` is the result as data
excitation        what to run next, where two explanations tie
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from grounded.diagnosis.attribution import attribute
from grounded.diagnosis.claims import Claims
from grounded.diagnosis.data import prepare
from grounded.diagnosis.decide import Decision, decide, ordered, plain, shares
from grounded.diagnosis.delays import delays_of
from grounded.diagnosis.fitted import Fitted
from grounded.diagnosis.held_out import shrinkage, utility_prediction
from grounded.diagnosis.hypothesis import Hypothesis, Predictor, param_scale
from grounded.diagnosis.leftover import Leftover, leftovers, whiteness
from grounded.diagnosis.limits import Limits, held, identifiable, knowable, limits
from grounded.diagnosis.prediction_error import by_region, by_time, explained, horizon
from grounded.diagnosis.report import (
    Change,
    ChannelShare,
    Credit,
    Diagnosis,
    Gap,
    Identifiable,
    NoiseLevels,
    Remainder,
    RulerRow,
    RunChange,
    Split,
    UtilityPrediction,
    Where,
)
from grounded.diagnosis.ruler import Ruler, repeated
from grounded.diagnosis.search import HypothesisSearch
from grounded.diagnosis.split import split
from grounded.diagnosis.verdict import next_trial, verdict
from grounded.effects import Library
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True)
class DiagnosisOptions:
    """How to diagnose.

    Args:
        library: the families that may be blamed.
        max_effects: at most so many at once.
        horizon: how far ahead predictions are judged [s].
        hidden: states that no sensor has: the memory of effects that were adopted.
        but: effects that are not blamed, by name: adopted ones, whose numbers are parameters now.
    """

    library: Library = field(default_factory=Library)
    max_effects: int = 3
    horizon: float = 1.0
    hidden: tuple[str, ...] = ()
    but: Collection[str] = ()


def diagnose(
    subject: Task | Model,
    trials: Sequence[Trial],
    options: DiagnosisOptions | None = None,
    *,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Where the gap between model and trials lies, which effect makes it, how far it shrinks.

    Args:
        subject: the task (its latency counts as modelled) or the bare model.
        trials: real runs on one time grid, whatever policy they ran.
        options: library, number of effects, horizon.
        progress: called with a word at every stage, for a display.

    Raises:
        GroundedError: for trials that don't fit the model, or with nothing in them.
    """
    options, tick = options or DiagnosisOptions(), progress or (lambda word: None)
    model = subject.model if isinstance(subject, Task) else subject
    latency = subject.latency if isinstance(subject, Task) else None
    past = subject.past if isinstance(subject, Task) else None
    data = prepare(model, trials, latency, past, options.hidden)
    known = limits(data)
    tick("candidates")
    uncertain = Predictor(data)
    with np.errstate(all="ignore"):
        search = HypothesisSearch(data, ())
        first = search.refined([search.fresh(Hypothesis())], FIRST_LOOK)
        data = replace(data, model=held(uncertain, first[0])) if first else data
    offered = options.library.candidates(data.model, data.scales)
    candidates = knowable(data, [e for e in offered if e.name not in options.but])
    search, best = attribute(data, candidates, max_effects=options.max_effects, tick=tick)
    tick("predict")
    used = [trial for trial in trials if trial.known_steps >= 2]
    with np.errstate(all="ignore"):
        decision = decide(search, best, ruler := Ruler(search.predictor), options.max_effects)
        tick("leftover")
        task = subject if isinstance(subject, Task) else None
        found = _Writer(decision, ruler, known, options, tick, task, used).diagnosis()
        return replace(found, identifiable=tuple(_identified(uncertain, decision.fit)))


FIRST_LOOK = 6  # iterations of the fit by whose noise the parameters are found identifiable
ABOVE = 1.3  # times the noise floor: what is left is stated
COUNTS = (2.0, 0.03)  # scatters, and least gain, of a flexible correction that is stated


def _identified(uncertain: Predictor, best: Fitted) -> list[Identifiable]:
    """Of all uncertain parameters, those that were held too, beside the best hypothesis."""
    if not param_scale(uncertain.data.model).any():
        return []
    return identifiable(uncertain, best)


class _Writer:
    """Turns a decision into a Diagnosis."""

    def __init__(
        self,
        decision: Decision,
        ruler: Ruler,
        known: Limits,
        options: DiagnosisOptions,
        tick: Callable[[str], None],
        task: Task | None,
        trials: Sequence[Trial],
    ) -> None:
        self.decision, self.ruler, self.known, self.options = decision, ruler, known, options
        self.tick, self.task, self.trials = tick, task, trials
        self.search, self.best = decision.search, decision.fit
        self.predictor, self.data = self.search.predictor, self.search.data
        self.shown = list(zip(ruler.shown, ruler.names, strict=True))
        self.units = {n: self.data.model.states[n] for n in ruler.names}
        self.credit = shares(ruler, decision)
        self.claims = Claims(decision, self.credit, known)
        self.left = leftovers(self.predictor, self.best)
        self.floor, self.source = self.noise_floor()

    def diagnosis(self) -> Diagnosis:
        data, predictor = self.data, self.predictor
        self.tick("gap")
        where = horizon(predictor, self.best, self.options.horizon)
        bare = self.decision.crude.track  # a prediction starts from its own hypothesis' states
        shrunk = shrinkage(predictor, self.best, bare, where)
        gain = explained(predictor, Hypothesis(), self.best)
        if self.left:
            i = data.model.state_names.index(self.left[0].channel)
            gain = gain.copy()
            gain[..., i] += self.left[0].improvement
        ranking = self.claims.ranking(where, shrunk.gap_before)
        groups = self.claims.groups()
        alike = self.claims.nearly(groups)
        remainder = self.remainders()
        rows, credit = self.prediction_error(), self.credits()
        return Diagnosis(
            verdict=verdict(self.claims, ranking, groups, remainder, rows, credit),
            where=Where(
                channels=self.channels(gain, shrunk.before, where.spread),
                times=tuple(by_time(gain.sum(axis=-1), data)),
                regions=tuple(by_region(gain.sum(axis=-1), predictor, self.best)),
                split=self.split(),
                whiteness=self.whiteness(),
            ),
            ranking=ranking,
            indistinguishable=groups,
            lookalikes=alike,
            gap=Gap(
                horizon_s=where.steps * data.dt,
                unit="noise-normalised rms",
                before=shrunk.gap_before,
                after=shrunk.gap_after,
                floor=1.0,
                held_out=self.ruler.held_out,
                channels=self.by_channel(shrunk.before, shrunk.after, where.spread),
            ),
            utility_prediction=self.utility_prediction(bare),
            whole_run=self.whole_run(),
            leftover=remainder,
            next_trial=next_trial(self.claims, self.left, groups),
            unknowable=self.known.sentences,
            noise=self.noise(),
            parameters=self.claims.parameters(),
            prediction_error=rows,
            credit=credit,
            trials=data.count,
            steps=data.steps,
            candidates=len(self.search.candidates),
        )

    def rms(self, fit: Fitted) -> Array:
        """By horizon and shown state, (K, n')."""
        return np.asarray(self.ruler.errors(fit).rms[:, self.ruler.shown])

    def calibrated(self) -> Fitted | None:
        """The model with its parameters fitted; as it is where that predicts no better."""
        fits = [f for (_, spread, names), f in self.search.fits.items() if spread and not names]
        if not fits:
            return None
        best, crude = max(fits, key=self.search.score), self.decision.crude
        return best if self.ruler.gain(crude, best).mean > 0 else crude

    def noise_floor(self) -> tuple[Array, str]:
        """Rms error that no model undercuts, by horizon and shown state, and where it is from.

        Noise that seems coloured counts as such where no flexible model finds anything in it.
        """
        repeats = repeated(self.trials, self.data)
        found, source = self.ruler.scatter(self.best, repeats), "repeats"
        if found is None:
            source = "short horizon"
            fit = self.best if not self.left else plain(self.search, self.best)
            starts = (horizon(self.predictor, fit, k * self.data.dt) for k in self.ruler.steps)
            rows = [
                _rms(np.where(self.data.seen[w.at + w.steps, w.run] > 0, w.spread, np.nan))
                for w in starts
            ]
            found = np.array([*rows, np.full_like(rows[0], np.nan)])
        reached = [e.rms for _, e in self.ruler.measured]
        return np.fmin(found, np.fmin.reduce(reached))[:, self.ruler.shown], source

    def prediction_error(self) -> tuple[RulerRow, ...]:
        """The ruler's table: 0.1, 0.5, 1 s and the whole trial."""
        calibrated = self.calibrated()
        columns = {
            "crude": self.rms(self.decision.crude),
            "calibrated": None if calibrated is None else self.rms(calibrated),
            "with_effects": self.rms(self.best),
            "noise_floor": self.floor,
        }
        by = "trials" if self.data.count > 1 else "pieces"
        rows = []
        for k, seconds in self.horizons():
            found = {
                key: {} if rms is None else dict(zip(self.units, map(float, rms[k]), strict=True))
                for key, rms in columns.items()
            }
            rows.append(
                RulerRow(
                    seconds,
                    k == len(self.ruler.steps),
                    self.units,
                    by if self.ruler.held_out else "no",
                    floor_from=self.source,
                    **found,
                )
            )
        return tuple(rows)

    def horizons(self) -> list[tuple[int, float]]:
        """(index, seconds) of the ruler's rows; a single step is no row unless it is 0.1 s."""
        dt, steps = self.data.dt, self.ruler.steps
        first = 0 if len(steps) < 2 or dt > 0.05 else 1
        rows = [(k, steps[k] * dt) for k in range(first, len(steps))]
        return [*rows, (len(steps), float(np.median(self.data.lengths)) * dt)]

    def credits(self) -> tuple[Credit, ...]:
        """What each cause is worth, largest first."""
        k = len(self.ruler.steps) - 1
        return tuple(
            Credit(
                name,
                self.credit[name],
                dict(
                    zip(
                        self.units,
                        map(float, self.rms(self.decision.without[name])[k]),
                        strict=True,
                    )
                ),
            )
            for name in ordered(self.credit, list(self.credit))
        )

    def remainders(self) -> tuple[Remainder, ...]:
        """What is left above the floor, and what a flexible model finds that would show there."""
        k, data, ruler = len(self.ruler.steps) - 1, self.data, self.ruler
        now, fine = self.rms(self.best), ruler.fine[ruler.shown]
        short = slice(0, len(ruler.steps))
        least = np.maximum(np.log(ABOVE), 2 * ruler.doubt(self.best))
        above = (np.log(now / self.floor) > least) & (now > 2 * fine)
        flexible, found = {left.channel: left for left in self.left}, []
        for i, name in enumerate(ruler.names):
            left = flexible.get(name)
            error, floor = float(now[k, i]), float(self.floor[k, i])
            if left is not None and not self.counts(left):
                left = None
            if left is None and not above[short, i].any():
                continue
            at = k
            if left is None and not above[k, i]:
                at = int(np.flatnonzero(above[short, i])[-1])
                error, floor = float(now[at, i]), float(self.floor[at, i])
            row = Remainder(
                name,
                error=error,
                floor=floor,
                horizon_s=ruler.steps[at] * data.dt,
                error_unit=self.units[name],
            )
            found.append((left is None, -error / max(floor, float(fine[i])), i, left, row))
        return tuple(self.with_region(row, left) for *_, left, row in sorted(found, key=_first))

    def counts(self, left: Leftover) -> bool:
        """Whether predictions would gain by a flexible model's correction."""
        rate = np.zeros((*left.correction.shape, self.data.model.n))
        rate[..., self.data.model.state_names.index(left.channel)] = left.correction
        return self.ruler.corrected(self.best, rate).beyond(*COUNTS)

    def with_region(self, row: Remainder, left: Leftover | None) -> Remainder:
        """A remainder with what a flexible model says of it: the missing rate, and where."""
        if left is None:
            return row
        size = left.correction**2 * self.data.valid.T
        regions = by_region(size, self.predictor, self.best, 1)
        region = regions[0] if regions else None
        return replace(row, size=left.size, unit=left.unit, evidence=left.gain, region=region)

    def split(self) -> dict[str, Split]:
        """Explained, unexplained, irreducible: one step, the horizon, a whole trial."""
        steps, dt = self.ruler.steps, self.data.dt
        rows = {"one_step": 0, "horizon": len(steps) - 1, "whole_run": len(steps)}
        seconds = [*(k * dt for k in steps), float(np.median(self.data.lengths)) * dt]
        before, after = self.rms(self.decision.crude), self.rms(self.best)
        return {
            key: split(seconds[k], self.units, before[k], after[k], self.floor[k], self.source)
            for key, k in rows.items()
        }

    def whole_run(self) -> dict[str, RunChange]:
        """Errors of predictions from the beginning of each trial to its end."""
        before, after = self.rms(self.decision.crude)[-1], self.rms(self.best)[-1]
        rows = zip(self.units.items(), before, after, strict=True)
        return {n: RunChange(float(b), float(a), unit) for (n, unit), b, a in rows}

    def channels(self, gain: Any, error: Any, spread: Any) -> tuple[ChannelShare, ...]:
        """Each state's part of the gap."""
        data = self.data
        excess = np.maximum(gain.sum(axis=(0, 1)), 0.0)
        share = excess / max(float(excess.sum()), 1e-12)
        rms = _rms(error)
        rows = [
            ChannelShare(
                name,
                share=float(share[i]),
                rms=float(rms[i]),
                unit=data.model.states[name],
                noise=float(np.sqrt((spread[:, i] ** 2).mean())),
            )
            for i, name in self.shown
        ]
        return tuple(sorted(rows, key=lambda row: -row.share))

    def by_channel(self, before: Any, after: Any, spread: Any) -> dict[str, Change]:
        """The gap of each state, noise-normalised."""
        found = {}
        for i, name in self.shown:
            found[name] = Change(*(float(_rms(e[:, i] / spread[:, i])) for e in (before, after)))
        return found

    def noise(self) -> NoiseLevels:
        """The noise as it was estimated."""
        noise = self.best.noise
        tau = noise.structure.tau
        q, r = np.exp(0.5 * noise.log_q), np.exp(0.5 * noise.log_r)
        return NoiseLevels(
            process={name: float(q[i]) for i, name in self.shown},
            measurement={name: float(r[i]) for i, name in self.shown},
            correlation_s=np.nan if tau is None else tau,
            outliers=not isinstance(noise.weight_v, float),
        )

    def whiteness(self) -> dict[str, float]:
        """The chance that white noise leaves innovations as correlated as these, by channel."""
        delays = delays_of(self.best.hypothesis, self.data)
        seen = self.data.seen if delays is None else delays.samples()[1]
        found = whiteness(self.best, seen)
        return {name: found[str(i)] for i, name in self.shown}

    def utility_prediction(self, bare: Any) -> UtilityPrediction | None:
        """Rms errors of predicted utilities, held out; None for a bare model."""
        if self.task is None:
            return None
        self.tick("utility")
        found = utility_prediction(self.predictor, self.best, bare, self.task, self.trials)
        return found.summary()


def _first(each: tuple[Any, ...]) -> tuple[Any, ...]:
    """Sorts remainders: where a flexible model finds a rate first, then by size."""
    return each[:3]


def _rms(error: Any) -> Any:
    """Root mean square along the first axis; nan for a state that was never measured."""
    count = np.isfinite(error).sum(axis=0)
    total = np.nansum(error**2, axis=0)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
