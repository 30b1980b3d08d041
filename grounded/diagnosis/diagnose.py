"""START HERE: the sim-to-real gap, diagnosed. Trials and a crude model in, a verdict out.

limits       what can't be known from these data
attribution  which effects, by evidence                      (effects/, scan, refine, noise)
calibration  or which of the model's own parameters
leftover     what no effect explains
gap          where the gap lies: channels, times, regions
shrinkage    how far it shrinks on trials that were left out
excitation   what to run next, where two explanations tie
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from grounded.diagnosis.attribution import attribute
from grounded.diagnosis.calibration import blamed
from grounded.diagnosis.data import prepare, usable
from grounded.diagnosis.fitted import Fit, calibrated
from grounded.diagnosis.gap import Horizon, by_region, by_time, explained, horizon, normalised
from grounded.diagnosis.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.intervals import standard_deviations
from grounded.diagnosis.leftover import Leftover, leftovers, whiteness
from grounded.diagnosis.limits import Limits, knowable, limits
from grounded.diagnosis.lookalike import Likeness, lookalikes
from grounded.diagnosis.report import (
    Diagnosis,
    Estimate,
    Kind,
    Ranked,
    Remainder,
    number,
    quantity,
)
from grounded.diagnosis.search import CLAIM, TIE, Search, parametric
from grounded.diagnosis.shrinkage import gaps_of, held_out, shrinkage, whole_runs
from grounded.diagnosis.split import repeated, split
from grounded.diagnosis.utility_prediction import utility_prediction
from grounded.diagnosis.words import distinguishing, improvement, meaning, nearly, sentence, tied
from grounded.effects import Effect, Library, ParamFamily, SensorDelayFamily, SensorFamily
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial

RANKED = 12  # explanations that are listed


@dataclass(frozen=True)
class Options:
    """How to diagnose.

    Args:
        library: the families that may be blamed.
        max_effects: at most so many at once.
        horizon: how far ahead predictions are judged [s].
    """

    library: Library = field(default_factory=Library)
    max_effects: int = 3
    horizon: float = 1.0


def diagnose(
    subject: Task | Model,
    trials: Sequence[Trial],
    options: Options | None = None,
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
    options, tick = options or Options(), progress or (lambda word: None)
    model = subject.model if isinstance(subject, Task) else subject
    latency = subject.latency if isinstance(subject, Task) else None
    past = subject.past if isinstance(subject, Task) else None
    data = prepare(model, trials, latency, past)
    known = limits(data)
    tick("candidates")
    candidates = knowable(data, options.library.candidates(model, data.scales), ())
    search, best = attribute(data, candidates, max_effects=options.max_effects, tick=tick)
    tick("leftover")
    with np.errstate(all="ignore"):
        left = leftovers(search.predictor, best)
        task = subject if isinstance(subject, Task) else None
        used = [trial for trial in trials if usable(trial) >= 2]
        return _Writer(search, best, left, known, options, tick, task, used).diagnosis()


class _Writer:
    """Turns a search into a Diagnosis."""

    def __init__(
        self,
        search: Search,
        best: Fit,
        left: list[Leftover],
        known: Limits,
        options: Options,
        tick: Callable[[str], None],
        task: Task | None,
        trials: Sequence[Trial],
    ) -> None:
        self.task, self.trials = task, trials
        self.search, self.best, self.left, self.known = search, best, left, known
        self.options, self.tick = options, tick
        self.predictor, self.data = search.predictor, search.data
        self.null = search.best_null()
        self.names = best.hypothesis.names
        self.alike: tuple[Likeness, ...] = ()
        self.base = search.score(search.exact_null() if parametric(best) else self.null)
        calibrating = not self.names and not left and search.calibrates()
        self.blamed = blamed(self.data, self.null) if calibrating else ()

    def diagnosis(self) -> Diagnosis:
        data, predictor = self.data, self.predictor
        self.tick("gap")
        where = horizon(predictor, self.best, self.options.horizon)
        track = self.track()
        shrunk = shrinkage(predictor, self.best, track, where)
        gain = explained(predictor, Hypothesis(), self.best)
        if self.left:
            i = data.model.state_names.index(self.left[0].channel)
            gain = gain.copy()
            gain[..., i] += self.left[0].improvement
        ranking = self.ranking(track, where, shrunk.gap_before)
        groups = self.groups()
        self.alike = self.nearly(groups)
        remainder = tuple(self.remainder(left) for left in self.left)
        kind, sentence = self.verdict(
            shrunk.gap_before, shrunk.gap_after, ranking, groups, remainder
        )
        named = tuple(row.effect for row in ranking if row.claimed)
        return Diagnosis(
            kind=kind,
            effects=named,
            sentence=sentence,
            channels=tuple(self.channels(gain, shrunk.before, where.spread)),
            times=tuple(by_time(gain.sum(axis=-1), data)),
            regions=tuple(by_region(gain.sum(axis=-1), predictor, self.best)),
            ranking=ranking,
            indistinguishable=groups,
            gap={
                "horizon_s": where.steps * data.dt,
                "unit": "noise-normalised rms",
                "before": shrunk.gap_before,
                "after": shrunk.gap_after,
                "floor": 1.0,
                "held_out": data.count > 1,
                "channels": self.by_channel(shrunk.before, shrunk.after, where.spread),
            },
            leftover=remainder,
            next_trial=self.next_trial(groups),
            unknowable=self.known.sentences,
            noise=self.noise(),
            whole_run=self.whole_run(track),
            parameters=self.parameters(),
            lookalikes=self.alike,
            split=self.split(track, where),
            whiteness=self.whiteness(),
            utility_prediction=self.utility_prediction(track),
            trials=data.count,
            steps=data.steps,
            candidates=len(self.search.candidates),
        )

    def track(self) -> Any:
        """Filtered states that predictions start from: the best hypothesis', as logged."""
        sensors = [
            e
            for e in self.best.hypothesis.effects
            if isinstance(e.family, SensorFamily | SensorDelayFamily)
        ]
        return self.null.track if sensors else self.best.track

    def ranking(self, track: Any, where: Any, before: float) -> tuple[Ranked, ...]:
        """The claimed effects first (by what would be lost without each), then what lost."""
        search, rows = self.search, []
        parts = self.parts()
        after = normalised(held_out(self.predictor, self.best, track, where), where)
        for name in sorted(self.names, key=lambda n: -parts[n]):
            claimed = not self.known.no_cause
            rows.append(self._row(self.best, name, parts[name], after, before, claimed=claimed))
        rows += self.off(after, before)
        listed = [row.effect for row in rows]
        singles = [f for f in search.of_size(1) if f.hypothesis.names[0] not in listed]
        singles = singles[: max(RANKED - len(rows), 3)]
        gaps = gaps_of(self.predictor, singles, track, where)
        for fit, gap in zip(singles, gaps, strict=True):
            name = fit.hypothesis.names[0]
            evidence = search.score(fit) - self.base
            rows.append(self._row(fit, name, evidence, gap, before, claimed=False))
        return tuple(rows)

    def off(self, after: float, before: float) -> list[Ranked]:
        """The model's own parameters, where calibrating them explains the gap."""
        model, known, rows = self.data.model, self.parameters(), []
        for blame in self.blamed:
            name = model.param_names[blame.index]
            nominal, e = float(model.values[blame.index]), known[name]
            d = Estimate(e.value - nominal, e.std, e.low - nominal, e.high - nominal, e.unit)
            rows.append(
                Ranked(
                    effect=f"parameter:{name}",
                    params={"d": d},
                    fixed={},
                    evidence=blame.nats,
                    gap_after=after,
                    shrinkage=1 - after / before if before > 0 else 0.0,
                    claimed=not self.known.no_cause,
                )
            )
        return rows

    def parts(self) -> dict[str, float]:
        """What the evidence loses without each claimed effect."""
        search, found = self.search, {}
        whole = search.score(self.best)
        for name in self.names:
            rest = tuple(sorted(n for n in self.names if n != name))
            fits = [
                f for f in search.of_size(len(rest)) if tuple(sorted(f.hypothesis.names)) == rest
            ]
            scores = [search.score(f) for f in fits] if rest else []
            found[name] = whole - max(scores or [self.base])
        return found

    def _row(
        self, fit: Fit, name: str, evidence: float, gap: float, before: float, *, claimed: bool
    ) -> Ranked:
        index = fit.hypothesis.names.index(name)
        effect = fit.hypothesis.effects[index]
        return Ranked(
            effect=name,
            params=self.estimates(fit)[index],
            fixed=effect.fixed,
            evidence=evidence,
            gap_after=gap,
            shrinkage=1 - gap / before if before > 0 else 0.0,
            claimed=claimed,
        )

    def estimates(self, fit: Fit) -> list[dict[str, Estimate]]:
        """Values with intervals, effect by effect."""
        stds, halves = standard_deviations(fit, self.data.trial_of)
        found, at = [], 0
        for effect, values in zip(fit.hypothesis.effects, fit.hypothesis.values, strict=True):
            some = {}
            for q in effect.free:
                v, s, w = float(values[q.name]), float(stds[at]), float(halves[at])
                some[q.name] = Estimate(v, s, v - w, v + w, q.unit)
                at += 1
            found.append(some)
        return found

    def groups(self) -> tuple[tuple[str, ...], ...]:
        """For each claimed effect, what could stand in its place within a few nats."""
        found = []
        whole = self.search.score(self.best)
        for name in self.names:
            rest = set(self.names) - {name}
            rivals = [
                f
                for f in self.search.of_size(len(self.names))
                if rest <= set(f.hypothesis.names) and name not in f.hypothesis.names
            ]
            close = [f for f in rivals if whole - self.search.score(f) < TIE]
            others = [next(n for n in f.hypothesis.names if n not in rest) for f in close[:2]]
            if others:
                found.append((name, *others))
        return tuple(found)

    def nearly(self, groups: tuple[tuple[str, ...], ...]) -> tuple[Likeness, ...]:
        """Look-alikes by shape, beside those that tie."""
        if self.known.no_cause:
            return ()
        tied = {(group[0], other) for group in groups for other in group[1:]}
        found = lookalikes(self.predictor, self.best, self.search.candidates)
        return tuple(one for one in found if (one.effect, one.like) not in tied)

    def remainder(self, left: Leftover) -> Remainder:
        """A leftover with the region where it acts."""
        size = left.correction**2 * self.data.valid.T
        regions = by_region(size, self.predictor, self.best, 1)
        return Remainder(
            left.channel, left.size, left.unit, left.gain, regions[0] if regions else None
        )

    def verdict(
        self,
        before: float,
        after: float,
        ranking: tuple[Ranked, ...],
        groups: tuple[tuple[str, ...], ...],
        remainder: tuple[Remainder, ...],
    ) -> tuple[Kind, str]:
        left = "; ".join(r.sentence() for r in remainder[:2])
        if self.known.no_cause:
            return "unknown", f"No cause is named: {self.known.sentences[0]}."
        if self.blamed:
            return self._calibration(before, after, ranking)
        if not self.names and not remainder:
            return "none", (
                f"The model explains the data down to the noise (predictions "
                f"{number(before)} times what noise alone makes)."
            )
        if not self.names:
            return "unknown", f"A gap remains that no known effect explains: {left}."
        effects = {e.name: e for e in self.best.hypothesis.effects}
        claimed = [row for row in ranking if row.claimed]
        words = [sentence(meaning(effects[row.effect], row.params) for row in claimed)]
        words.append(improvement(before, after))
        words += [f"The data can't tell {tied(group)}." for group in groups]
        if self.alike:
            words.append(nearly(self.alike))
        if remainder:
            words.append(f"Something is left that no known effect explains: {left}.")
        return ("effect" if len(self.names) == 1 else "several"), " ".join(words)

    def _calibration(
        self, before: float, after: float, ranking: Sequence[Ranked]
    ) -> tuple[Kind, str]:
        """The model's form is right, its numbers are not."""
        model, listed = self.data.model, []
        for row in ranking[: len(self.blamed)]:
            name = row.effect.partition(":")[2]
            nominal, d = model.params[name].value, row.params["d"]
            new = quantity(replace(d, value=nominal + d.value))
            part = f" ({d.value / abs(nominal):+.1%})" if nominal else ""
            listed.append(f"{name} should be {new}{part}")
        text = sentence(["the model's form explains the data, its numbers don't", *listed])
        words = [text, improvement(before, after), "`grounded fit` fits them all."]
        return ("effect" if len(listed) == 1 else "several"), " ".join(words)

    def channels(self, gain: Any, error: Any, spread: Any) -> list[dict[str, Any]]:
        """Each state's part of the gap."""
        data = self.data
        excess = np.maximum(gain.sum(axis=(0, 1)), 0.0)
        share = excess / max(float(excess.sum()), 1e-12)
        rms = np.sqrt(np.nanmean(error**2, axis=0))
        rows = [
            {
                "name": name,
                "share": float(share[i]),
                "rms": float(rms[i]),
                "unit": data.model.states[name],
                "noise": float(np.sqrt((spread[:, i] ** 2).mean())),
            }
            for i, name in enumerate(data.model.state_names)
        ]
        return sorted(rows, key=lambda row: -float(row["share"]))

    def by_channel(self, before: Any, after: Any, spread: Any) -> dict[str, Any]:
        """The gap of each state, noise-normalised."""
        found = {}
        for i, name in enumerate(self.data.model.state_names):
            b, a = (
                float(np.sqrt(np.nanmean((e[:, i] / spread[:, i]) ** 2))) for e in (before, after)
            )
            found[name] = {"before": b, "after": a}
        return found

    def parameters(self) -> dict[str, Estimate]:
        """Values of the model's parameters where they were calibrated beside the effects."""
        h, model = self.best.hypothesis, self.data.model
        if h.spread == 0 or h.shift is None:
            return {}
        stds, halves = standard_deviations(self.best, self.data.trial_of)
        scale, k = param_scale(model), len(h.theta)
        found = {}
        for at, index in enumerate(calibrated(self.data)):
            value = float(model.values[index] + h.shift[index])
            std, half = (float(a[k + at] * scale[index]) for a in (stds, halves))
            name = model.param_names[index]
            found[name] = Estimate(value, std, value - half, value + half, model.params[name].unit)
        return found

    def noise(self) -> dict[str, Any]:
        """The noise as it was estimated."""
        noise, names = self.best.noise, self.data.model.state_names
        q, r = np.exp(0.5 * noise.log_q), np.exp(0.5 * noise.log_r)
        return {
            "process": {n: float(v) for n, v in zip(names, q, strict=True)},
            "measurement": {n: float(v) for n, v in zip(names, r, strict=True)},
            "correlation_s": noise.structure.tau,
            "outliers": not isinstance(noise.weight_v, float),
        }

    def whole_run(self, track: Any) -> dict[str, Any]:
        """Errors of predictions from the first state to the end of each run."""
        names = self.data.model.state_names
        before = whole_runs(self.predictor, Hypothesis(), track)
        after = whole_runs(self.predictor, self.best.hypothesis, track)
        return {
            n: {"before": float(b), "after": float(a), "unit": self.data.model.states[n]}
            for n, b, a in zip(names, before, after, strict=True)
        }

    def split(self, track: Any, where: Horizon) -> dict[str, Any]:
        """Explained, unexplained, irreducible: one step, the horizon, a whole run."""
        repeats = repeated([trial.candidate for trial in self.trials])
        horizons = {
            "one_step": horizon(self.predictor, self.best, self.data.dt),
            "horizon": where,
            "whole_run": horizon(self.predictor, self.best, np.inf),
        }
        return {
            name: split(self.predictor, self.best, track, one, repeats).to_dict(self.data)
            for name, one in horizons.items()
        }

    def whiteness(self) -> dict[str, float]:
        """The chance that white noise leaves innovations as correlated as these, by channel."""
        found = whiteness(self.best, self.data.seen)
        return {name: found[str(i)] for i, name in enumerate(self.data.model.state_names)}

    def utility_prediction(self, track: Any) -> dict[str, Any] | None:
        """Rms errors of predicted utilities, held out; None for a bare model."""
        if self.task is None:
            return None
        self.tick("utility")
        found = utility_prediction(self.predictor, self.best, track, self.task, self.trials)
        return found.to_dict()

    def next_trial(self, groups: tuple[tuple[str, ...], ...]) -> str:
        """A sentence; `excitation.probe` makes the trial itself."""
        if self.known.no_cause:
            return "Run two or more trials in which every input changes."
        if groups:
            return " ".join(
                [f"Run a probe that tells {tied(groups[0])}.", *distinguishing(groups[0])]
            )
        if not self.names and self.left:
            return (
                f"Repeat a trial twice with the same inputs to see whether the leftover in "
                f"{self.left[0].channel} repeats."
            )
        if not self.names and not self.blamed:
            return "Nothing is tied and nothing to adopt: go on with the search."
        return "Nothing is tied: go on with the search, or adopt the effect first."


__all__ = ["CLAIM", "Diagnosis", "Effect", "Options", "ParamFamily", "diagnose"]
