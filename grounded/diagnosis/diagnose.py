"""START HERE: diagnose the sim-to-real gap, from trials and a crude model to a verdict.

The stages and their modules:

limits            correct the sensors; what the data can't show  (accounts)
attribution       search for effects by evidence   (search, hypotheses, scan, refine, noise, fitted)
ruler             held-out prediction errors in the channels' units
decide            choose the claim by the ruler, among hypotheses proposed by evidence  (choose)
measured          errors, noise floor, credit of each cause, leftover; where the gap is
claims            claimed effects with intervals, ties and look-alikes  (lookalike)
identifiable      what the data determine of each value, and what only priors set
leftover          structure that no effect explains, and a curve that predicts it
agreement         agreement of the trials; changes between two groups of them
writer            the result, its findings and the next step; telling: its lines
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from grounded.accounts.finding import SENSOR_DELAY, Preflight, late_as_positions
from grounded.checks import list_of, of_type, whole_number
from grounded.diagnosis.hypotheses.attribution import (
    USUAL_EFFECTS,
    attribute,
    grown,
    regrown,
    so_far,
)
from grounded.diagnosis.hypotheses.search import TO_THE_TOP, HypothesisSearch
from grounded.diagnosis.likelihood.data import Data
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.simulated import simulated
from grounded.diagnosis.parts import Diagnosis
from grounded.diagnosis.validation.agreement import compared
from grounded.diagnosis.validation.decide import Decision, beside_lookalikes, decide
from grounded.diagnosis.validation.identifiable import held
from grounded.diagnosis.validation.limits import knowable, sound_data, without_others
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.writer import MOST_EFFECTS, written
from grounded.effects import Effect, Library, param_name
from grounded.effects.actuator import delay, delay_again
from grounded.engine import Engine, running, steady
from grounded.findings import Weight, found
from grounded.model import Model
from grounded.progress import Stages, interruptible
from grounded.result import listed
from grounded.task import Task
from grounded.trial import Trial


@dataclass(frozen=True)
class DiagnosisOptions:
    """Options of a diagnosis.

    Args:
        library: the families that may be blamed.
        max_effects: largest number of effects at once, 1 to 12, all of which are searched while
            likely effects remain; None: 3, and one more at a time while that pays.
        hidden: names of states without a sensor, such as the memory of adopted effects.
        but: names of effects that are not blamed, such as adopted ones, whose values are now
            parameters of the model.
        one_message: states that are logged in one message, so that all or none of them are late.
        delays: adopted delays [s], {effect: delay}. They are part of the task's latency, and may
            turn out longer or shorter.
        interpolated_s: standard deviation of times [s] because the states were interpolated
            between the samples of a log.
        origin: the task before anything was adopted. Improvements are measured relative to the
            errors of its model, so that later diagnoses use the same scale as the first.

    Raises:
        GroundedError: if `library` or `max_effects` has another type or is out of range.
    """

    library: Library = field(default_factory=Library)
    max_effects: int | None = None
    hidden: tuple[str, ...] = ()
    but: Collection[str] = ()
    one_message: tuple[str, ...] = ()
    delays: Mapping[str, float] = field(default_factory=dict)
    interpolated_s: float = 0.0
    origin: Task | None = None

    def __post_init__(self) -> None:
        of_type("library", self.library, Library)
        if self.max_effects is not None:
            whole_number("max_effects", self.max_effects, 1, MOST_EFFECTS)


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
    """Find where the gap between model and trials is, and which effects cause it.

    Args:
        subject: the task (its latency counts as modelled) or a model.
        trials: real runs with one time step, under any policy.
        options: library, number of effects.
        compare: a second group of trials. Both groups are diagnosed together, and `changed` lists
            the values that differ between them.
        engine: workers that fit hypotheses; the result does not depend on their number.
        progress: called with the stage and the time taken, for a display.

    Returns:
        The diagnosis, with its verdict, ranking of effects and prediction errors.

    Raises:
        Interrupted: on Ctrl-C before the first verdict, with the best hypothesis so far. Later, the
            search for one more effect ends, and what was found before it is returned.
        GroundedError: if the trials don't fit the model, or hold no data.
    """
    of_type("model", subject, Task, Model)
    list_of(trials, Trial, "trials")
    options = of_type("options", options or DiagnosisOptions(), DiagnosisOptions)
    tick = Stages(progress)
    tick("instruments")
    sound = sound_data(
        subject,
        trials,
        compare,
        hidden=options.hidden,
        one_message=options.one_message,
        interpolated_s=options.interpolated_s,
    )
    data, looked = sound.data, sound.looked

    # what may be blamed, beside parameters that the data identify
    tick("candidates")
    uncertain = Predictor(data)
    with np.errstate(all="ignore"):
        alone = HypothesisSearch(data, ())
        null = alone.refined([alone.fresh(Hypothesis())], TO_THE_TOP)
        if null:
            data = replace(data, model=held(uncertain, null[0]))
            data = replace(data, model=without_others(data, options.but, options.library))
    candidates, joints = _offered(data, looked, options)

    # search by evidence, then decide by held-out predictions
    copied = not simulated(data.model)
    with running(engine, copied=copied):
        search, best = attribute(
            data,
            candidates,
            max_effects=options.max_effects,
            tick=tick,
            joints=joints,
            alone=null,
        )
    ruler = Ruler(search.predictor, options.origin)
    loop = Loop(search, ruler, tick, options.max_effects, len(best.hypothesis.effects))
    with (
        np.errstate(all="ignore"),
        interruptible(loop.so_far),
        running(engine, copied=copied),
    ):
        decision = loop.decided()
        tick("leftover")
        if not sound.limits.no_cause:
            decision = beside_lookalikes(decision)
        groups = [k < sound.first for k in range(data.count)]
        tick("gap")
        result = written(
            decision,
            ruler,
            sound,
            uncertain,
            adopted=(*options.but, *options.delays),
            most=loop.most,
            task=subject if isinstance(subject, Task) else None,
            apart=compared(search, decision.fit, groups) if compare else None,
        )

    delays = _sensor_delays(result, data.model, options.but)
    older = late_as_positions(looked.findings, delays, options.but)
    result = replace(result, preflight=(*result.preflight, *older))
    if loop.cut_short:
        again, cut = (
            replace(result.verdict, again=True),
            found("gap.more", interrupted=True, weight=Weight.WARN),
        )
        result = replace(result, verdict=again, findings=(*result.findings, cut))
    return result


def _offered(
    data: Data, looked: Preflight, options: DiagnosisOptions
) -> tuple[tuple[Effect, ...], tuple[Effect, ...]]:
    """Return the effects that may be blamed, and the plain frictions of joints."""
    library, late = options.library, options.delays
    settled = {*options.but, *looked.settled}
    settled |= {f"sensor_delay:{name}" for name in options.one_message}
    offered = list(library.candidates(data.model, data.scales))
    if delay in library.families:  # those of the inputs that moved in earlier trials
        known = {effect.name for effect in offered}
        offered += [library.effect(n, data.model, data.scales) for n in late if n not in known]
    shown = knowable(data, [e for e in offered if e.name not in settled], (*late,))
    candidates = tuple(_again(e, late[e.name], data) if e.name in late else e for e in shown)
    joints = library.joints(data.model, data.scales)
    return candidates, knowable(data, [e for e in joints if e.name not in settled])


class Loop:
    """Decide; while a gap remains, search on and decide anew.

    The search starts again without the leader, once. Then a choice that it has not extended is
    extended by one effect, or one more effect is sought, while predictions clearly improve.
    """

    def __init__(
        self,
        search: HypothesisSearch,
        ruler: Ruler,
        tick: Stages,
        max_effects: int | None,
        many: int,
    ) -> None:
        """`many`: effects of the likeliest set, more than usual if it has all joints of an arm."""
        self.search, self.ruler, self.tick = search, ruler, tick
        self.limit, self.whole = max_effects or MOST_EFFECTS, max_effects is not None
        self.most = min(self.limit, many + 1 if many > USUAL_EFFECTS else USUAL_EFFECTS)
        self.restarts = len(search.candidates) > PAIR  # may yet start without its leader
        self.decision: Decision | None = None
        self.cut_short = False

    def so_far(self) -> str:
        """Return what is told when it is interrupted before the first decision."""
        known = self.decision.fit.hypothesis.names if self.decision else None
        return so_far(self.search, self.most, known)

    def decided(self) -> Decision:
        """Return the decision; on Ctrl-C the last one, if there is one."""
        try:
            self.tick("predict")
            self.decision = decide(self.search, self.ruler)
            could = self.restarts
            while grow := self._next(before := self.decision):
                self.tick.beside = "one more effect; Ctrl-C keeps what was found"
                self.tick("more effects")
                grow()
                self.decision = decide(self.search, self.ruler)
                restarted, could = could and not self.restarts, self.restarts
                if not (restarted or self.ruler.gain(before.fit, self.decision.fit).clear):
                    break
        except KeyboardInterrupt:
            if self.decision is None:
                raise
            found = listed(self.decision.fit.hypothesis.names) or "no cause"
            self.cut_short, self.tick.beside = True, f"{found}: written down; Ctrl-C again ends it"
            self.tick("leftover")
        return self.decision

    def _next(self, decision: Decision) -> Callable[[], object] | None:
        """Return how the search goes on, None if it is over."""
        search, fit, size = self.search, decision.fit, len(decision.fit.hypothesis.names)
        if decision.gap and self.restarts and decision.leader:
            self.restarts = False
            return partial(regrown, search, decision.leader, max(size, PAIR))
        if decision.gap and 0 < size < self.most and fit is not search.of_size(size)[0]:
            return partial(grown, search, fit, size + 1)
        if self.most < self.limit and (self.whole or (decision.gap and size >= self.most)):
            self.most += 1
            return partial(grown, search, search.chosen(self.most), self.most)
        return None


def _sensor_delays(result: Diagnosis, model: Model, adopted: Collection[str]) -> dict[str, float]:
    """Return the delays of sensors that are part of the model or claimed, by effect [s]."""
    late = [name for name in adopted if name.startswith(SENSOR_DELAY)]
    known = {name: model.params[param_name(name, "d")].value for name in late}
    for row in result.ranking:
        if row.claimed and row.effect.startswith(SENSOR_DELAY):
            known[row.effect] = known.get(row.effect, 0.0) + row.values["d"]
    return known


def _again(effect: Effect, known: float, data: Data) -> Effect:
    """Return an adopted delay as a change of it, bounded so that the total is not negative."""
    late = data.latency[[data.model.input_names.index(name) for name in effect.site.targets]]
    return delay_again(effect, known, float(late.min()))


PAIR = 2  # effects at least that are sought without the leader
