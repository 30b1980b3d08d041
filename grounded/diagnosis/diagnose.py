"""START HERE: the sim-to-real gap, diagnosed. Trials and a crude model in, a verdict out.

preflight         the instruments, from their signals alone: corrected first  (instruments)
limits            what can't be known from these data; which parameters they identify
attribution       which effects, by evidence       (search, hypotheses, scan, refine, noise, fitted)
ruler             held-out prediction errors in the channels' units
decide            evidence proposes, the ruler decides; what each cause is worth
measured          what the ruler says of the decision: table, noise floor, credit, what is left
claims            what is claimed, what ties, what is nearly the same    (lookalike)
correction        a curve that predicts what is left, where it passes a test of its own
leftover          what no effect explains
agreement         whether the trials agree; what changed between two groups of them
prediction_error  where the gap lies: channels, times, regions
split             what the error is made of: explained, unexplained, irreducible
unconfirmed       what was seen once, and where
verdict           all of it in sentences; `report` is the result as data
excitation        what to run next, where two explanations tie
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from grounded.diagnosis.error_report import (
    Change,
    ChannelShare,
    Gap,
    RulerRow,
    UtilityPrediction,
    Where,
    furthest,
)
from grounded.diagnosis.hypotheses.attribution import attribute, grown, so_far
from grounded.diagnosis.hypotheses.correction import correction
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.report import Diagnosis, Estimate, Identifiable, NoiseLevels
from grounded.diagnosis.ruler_words import contested, open_noise
from grounded.diagnosis.unconfirmed import another_look, unconfirmed, unrepeatable
from grounded.diagnosis.validation.agreement import by_trial, compared
from grounded.diagnosis.validation.claims import Claims
from grounded.diagnosis.validation.decide import Decision, decide
from grounded.diagnosis.validation.held_out import shrinkage, utility_prediction
from grounded.diagnosis.validation.limits import (
    Limits,
    counted_once,
    held,
    identifiable,
    knowable,
    limits,
)
from grounded.diagnosis.validation.measured import Measured, root_mean_square
from grounded.diagnosis.validation.motions import how_many, without_others
from grounded.diagnosis.validation.prediction_error import by_region, by_time, explained, horizon
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.verdict import at_bounds, next_trial, verdict
from grounded.effects import Library, acting_order, wrapping_order
from grounded.engine import Engine, running, steady
from grounded.errors import GroundedError
from grounded.instruments.mistaken import judge_commands
from grounded.instruments.preflight import preflight
from grounded.model import Model
from grounded.progress import Stages, interruptible
from grounded.task import Task
from grounded.trial import Trial, scattered


@dataclass(frozen=True)
class DiagnosisOptions:
    """How to diagnose.

    Args:
        library: the families that may be blamed.
        max_effects: at most so many at once; None: 3, and more where those leave more than noise.
        horizon: how far ahead predictions are judged [s].
        hidden: states that no sensor has: the memory of effects that were adopted.
        but: effects that are not blamed, by name: adopted ones, whose numbers are parameters now.
        origin: the task before anything was adopted: what matters is measured by what its model
            misses, in the second diagnosis as in the first.
    """

    library: Library = field(default_factory=Library)
    max_effects: int | None = None
    horizon: float = 1.0
    hidden: tuple[str, ...] = ()
    but: Collection[str] = ()
    origin: Task | None = None


@steady()
def diagnose(
    subject: Task | Model,
    trials: Sequence[Trial],
    options: DiagnosisOptions | None = None,
    *,
    compare: Sequence[Trial] = (),
    engine: Engine | None = None,
    progress: Callable[[str], None] | None = None,
) -> Diagnosis:
    """Where the gap between model and trials lies, which effect makes it, how far it shrinks.

    Args:
        subject: the task (its latency counts as modelled) or the bare model.
        trials: real runs on one time grid, whatever policy they ran.
        options: library, number of effects, horizon.
        compare: a second group of trials; all are diagnosed, and what changed is `changed`.
        engine: workers that fit hypotheses; the same comes out on any number.
        progress: told of the stage, the share done and the time left, for a display.

    Raises:
        Interrupted: on Ctrl-C, with the best hypothesis so far and what it predicts.
        GroundedError: for trials that don't fit the model, or with nothing in them.
    """
    given: Any = trials
    loose = (
        [type(t).__name__ for t in given if not isinstance(t, Trial)]
        if hasattr(given, "__iter__")
        else []
    )
    if loose or not hasattr(given, "__iter__") or not isinstance(subject, Task | Model):
        raise GroundedError(
            "diagnose(task, trials) takes a Task or a Model and a list of Trials, got "
            f"{type(subject).__name__} and {' of '.join([type(given).__name__, *loose[:1]])}"
        )
    options, tick = options or DiagnosisOptions(), Stages(progress, USUAL)
    model = subject.model if isinstance(subject, Task) else subject
    if model.n + model.m > MOST_NAMES:
        raise GroundedError(
            f"model '{model.name}' has {model.n} states and {model.m} inputs; a diagnosis takes at "
            f"most {MOST_NAMES} of both together, each may be blamed for each: diagnose a model of "
            "the part where the gap is"
        )
    latency = subject.latency if isinstance(subject, Task) else None
    past = subject.past if isinstance(subject, Task) else None
    tick("instruments")
    trials, copies = counted_once(trials)
    compare, more = counted_once(compare)
    copies += more
    exact = bool(copies) and not scattered([*trials, *compare])
    first = sum(trial.known_steps >= 2 for trial in trials)
    looked = preflight(subject, [*trials, *compare], options.hidden)
    trials = looked.trials
    data = prepare(model, trials, latency, past, options.hidden)
    judge_commands(model, trials, options.hidden)
    filters = {model.state_names.index(name): tau for name, tau in looked.filters.items()}
    data = replace(data, filters=filters)
    known = limits(data, looked.left_out)
    known = replace(known, sentences=(*known.sentences, *copies))
    tick("candidates")
    uncertain = Predictor(data)
    with np.errstate(all="ignore"):
        search = HypothesisSearch(data, ())
        null = search.refined([search.fresh(Hypothesis())], FIRST_LOOK)
        if null:
            data = replace(data, model=held(uncertain, null[0]))
            model = without_others(Predictor(data), null[0].track, options.but, options.library)
            data = replace(data, model=model)
    offered = options.library.candidates(data.model, data.scales)
    settled = {*options.but, *looked.settled}
    candidates = knowable(data, [e for e in offered if e.name not in settled])
    joints = options.library.joints(data.model, data.scales)
    joints = knowable(data, [e for e in joints if e.name not in settled])
    most = options.max_effects or USUAL_EFFECTS
    with running(engine):
        search, best = attribute(data, candidates, max_effects=most, tick=tick, joints=joints)
    used = [trial for trial in trials if trial.known_steps >= 2]
    task = subject if isinstance(subject, Task) else None
    here = interruptible(lambda: so_far(search, most))
    with np.errstate(all="ignore"), here, running(engine):
        while True:
            tick("predict")
            ruler = Ruler(search.predictor, options.origin)
            decision = decide(search, best, ruler, most)
            tick("leftover")
            writer = _Writer(
                decision, ruler, known, options, most, tick, task, used, exact, uncertain
            )
            found = writer.diagnosis()
            if options.max_effects or not found.verdict.look_for:
                break
            most += 1
            tick("more effects")
            best = grown(search, best, most)
        groups = [k < first for k in range(data.count)]
        apart = compared(search, decision.fit, groups) if compare else None
        return replace(
            found,
            preflight=looked.findings,
            changed=apart.changed if apart else None,
            unchanged=apart.unchanged if apart else (),
        )


USUAL_EFFECTS = 3  # that are looked for at first
MOST_NAMES = 50  # of 36 and 12 come 1,649 effects, of 20 and 100 as many; each is filtered
USUAL = 160  # stages of a diagnosis, and hypotheses that are refined together
FIRST_LOOK = 6  # iterations of the fit by whose noise the parameters are found identifiable


def _identified(
    uncertain: Predictor, best: Fitted, known: Mapping[str, Estimate]
) -> list[Identifiable]:
    """Of all uncertain parameters, those that were held too, beside the best hypothesis."""
    if not param_scale(uncertain.data.model).any():
        return []
    return identifiable(uncertain, best, known)


def _in_action(h: Hypothesis, claimed: Sequence[str]) -> tuple[str, ...]:
    """Claimed effects in the order in which they act; parameters last."""
    families = [effect.family for effect in h.effects]
    order, whole = acting_order(families), wrapping_order(families)
    names = [h.names[i] for i in (*order, *(i for i in whole if i not in order))]
    return tuple(n for n in dict.fromkeys((*names, *claimed)) if n in claimed)


class _Writer:
    """Turns a decision into a Diagnosis."""

    def __init__(
        self,
        decision: Decision,
        ruler: Ruler,
        known: Limits,
        options: DiagnosisOptions,
        most: int,
        tick: Callable[[str], None],
        task: Task | None,
        trials: Sequence[Trial],
        exact: bool,
        uncertain: Predictor,
    ) -> None:
        self.decision, self.ruler, self.known, self.options = decision, ruler, known, options
        self.most, self.tick, self.task, self.trials = most, tick, task, trials
        self.search, self.best = decision.search, decision.fit
        self.predictor, self.data = self.search.predictor, self.search.data
        self.shown = list(zip(ruler.shown, ruler.names, strict=True))
        self.measured = Measured(decision, ruler, trials, exact)
        self.claims = Claims(decision, self.measured.credit, known, ruler)
        self.left, self.uncertain = self.measured.left, uncertain

    def diagnosis(self) -> Diagnosis:
        data, predictor = self.data, self.predictor
        self.tick("gap")
        where = horizon(predictor, self.best, self.options.horizon)
        bare = self.decision.crude.states  # a prediction starts from its own hypothesis' states
        shrunk = shrinkage(predictor, self.best, bare, where)
        gain = explained(predictor, Hypothesis(), self.best)
        if self.left:
            i = data.model.state_names.index(self.left[0].channel)
            gain = gain.copy()
            gain[..., i] += self.left[0].improvement
        ranking = self.claims.ranking(where, shrunk.gap_before)
        groups = self.claims.groups()
        same = self.claims.equivalent(groups)
        alike = self.claims.nearly(groups)
        measured = self.measured
        remainder = measured.remainders()
        rows, credit = measured.prediction_error(), measured.credits()
        off, region = open_noise(rows), None
        if remainder:
            off, region = remainder[0].channel, remainder[0].region
        when = region.when if region else ""
        look = another_look(self.task, self.trials, off, when) if off else ""
        named = [row.effect for row in ranking if row.claimed]
        seen = unconfirmed(self.claims, self.decision.doubtful, groups)
        values, agreement = by_trial(self.best, data, named) if named else ((), ())
        worse, adopted = contested(rows, agreement, named), self.options.but
        lost = self.unrepeatable()
        moved, parameters = how_many(predictor), self.claims.parameters()
        identified = tuple(_identified(self.uncertain, self.best, parameters))
        said = verdict(
            self.claims,
            ranking,
            groups,
            remainder,
            rows,
            credit,
            seen,
            same,
            self.most,
            one_motion=moved == 1 < data.count,
            given={one.parameter: tuple(one.given) for one in identified},
        )
        further = said.look_for > 0
        return Diagnosis(
            verdict=said,
            where=Where(
                channels=self.channels(gain, rows),
                times=tuple(by_time(gain.sum(axis=-1), data)),
                regions=tuple(by_region(gain.sum(axis=-1), predictor, self.best)),
                split=measured.split(),
                whiteness=measured.whiteness,
                tempering=self.search.tempering.factor,
            ),
            ranking=ranking,
            acting=_in_action(self.best.hypothesis, said.effects),
            indistinguishable=groups,
            equivalent=same,
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
            whole_run=measured.whole_run(),
            leftover=remainder,
            unconfirmed=seen,
            correction=correction(predictor, self.best, self.left, where),
            next_trial=next_trial(
                self.claims,
                look,
                groups,
                seen,
                same,
                lost,
                worse,
                adopted,
                further=further,
                ended=at_bounds(self.claims),
            ),
            unknowable=self.known.sentences,
            noise=self.noise(),
            parameters=parameters,
            identifiable=identified,
            prediction_error=rows,
            credit=credit,
            per_trial=values,
            agreement=agreement,
            trials=data.count,
            motions=moved,
            steps=data.steps,
            candidates=len(self.search.candidates),
        )

    def unrepeatable(self) -> dict[str, str]:
        """The trials that nobody can or should repeat."""
        return {} if self.task is None else unrepeatable(self.task, self.trials)

    def channels(self, gain: Any, rows: Sequence[RulerRow]) -> tuple[ChannelShare, ...]:
        """Each state's part of the gap, with the ruler's errors a second ahead."""
        excess = np.maximum(gain.sum(axis=(0, 1)), 0.0)
        share = excess / max(float(excess.sum()), 1e-12)
        ahead = furthest(rows) or rows[0]
        found = [
            ChannelShare(
                name,
                share=float(share[i]),
                rms=ahead.crude[name],
                unit=self.data.model.states[name],
                noise=ahead.noise_floor[name],
            )
            for i, name in self.shown
        ]
        return tuple(sorted(found, key=lambda one: -one.share))

    def by_channel(self, before: Any, after: Any, spread: Any) -> dict[str, Change]:
        """The gap of each state, noise-normalised."""
        found = {}
        for i, name in self.shown:
            found[name] = Change(
                *(float(root_mean_square(e[:, i] / spread[:, i])) for e in (before, after))
            )
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

    def utility_prediction(self, bare: Any) -> UtilityPrediction | None:
        """Rms errors of predicted utilities, held out; None for a bare model."""
        if self.task is None:
            return None
        self.tick("utility")
        found = utility_prediction(self.predictor, self.best, bare, self.task, self.trials)
        return replace(found.summary(), feedback=self.task.feedback)
