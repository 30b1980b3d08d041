"""START HERE: diagnose the sim-to-real gap, from trials and a crude model to a verdict.

The stages and their modules:

sound_trials      check and correct the sensors, from their signals alone       (accounts)
limits            what the data can't determine; which parameters they identify
attribution       search for effects by evidence   (search, hypotheses, scan, refine, noise, fitted)
ruler             held-out prediction errors in the channels' units
decide            choose the claim by the ruler, among hypotheses proposed by evidence
measured          table of errors, noise floor, credit of each cause, leftover
claims            claimed effects with intervals, ties and look-alikes           (lookalike)
leftover          structure that no effect explains
correction        a curve that predicts the leftover, if it passes its own test
agreement         agreement of the trials; changes between two groups of them
prediction_error  where the gap is, by channel, time and region
split             explained, unexplained and irreducible parts of the error
unconfirmed       effects that only few trials show, and where
verdict           the result in sentences (next_trial); `writer` assembles the `report`
excitation        the next trial, to separate two explanations that tie
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from grounded.accounts.finding import SENSOR_DELAY, late_as_positions
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
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.sound_data import sound_data
from grounded.diagnosis.validation.agreement import compared
from grounded.diagnosis.validation.decide import Decision, decide
from grounded.diagnosis.validation.limits import (
    counted_once,
    held,
    knowable,
    limits,
)
from grounded.diagnosis.validation.motions import without_others
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.verdict import MOST_EFFECTS, interrupted, with_faults
from grounded.diagnosis.writer import Writer
from grounded.effects import Effect, Library, param_name
from grounded.effects.actuator import delay, delay_again
from grounded.engine import Engine, running, steady
from grounded.errors import GroundedError, type_of
from grounded.frozen import positive, whole_number
from grounded.model import Model
from grounded.progress import Stages, interruptible
from grounded.share import share_of
from grounded.task import Task
from grounded.trial import Trial, scattered


@dataclass(frozen=True)
class DiagnosisOptions:
    """Options of a diagnosis.

    Args:
        library: the families that may be blamed.
        max_effects: largest number of effects at once, 1 to 12, all of which are searched while
            likely effects remain; None: 3, and one more at a time while that pays.
        horizon: how far ahead the gap is measured [s].
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
        GroundedError: if `library`, `max_effects` or `horizon` has another type or is out of range.
    """

    library: Library = field(default_factory=Library)
    max_effects: int | None = None
    horizon: float = 1.0
    hidden: tuple[str, ...] = ()
    but: Collection[str] = ()
    one_message: tuple[str, ...] = ()
    delays: Mapping[str, float] = field(default_factory=dict)
    interpolated_s: float = 0.0
    origin: Task | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.library, Library):
            raise GroundedError(f"library must be a Library, got a {type_of(self.library)}")
        if self.max_effects is not None:
            whole_number("max_effects", self.max_effects, 1, MOST_EFFECTS)
        positive("horizon", self.horizon)


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
        options: library, number of effects, horizon.
        compare: a second group of trials. Both groups are diagnosed together, and `changed` lists
            the values that differ between them.
        engine: workers that fit hypotheses; the result does not depend on their number.
        progress: called with the stage, the time taken and the time left, for a display.

    Returns:
        The diagnosis, with its verdict, ranking of effects and prediction errors.

    Raises:
        Interrupted: on Ctrl-C before the first verdict, with the best hypothesis so far. Later, the
            search for one more effect ends, and what was found before it is returned.
        GroundedError: if the trials don't fit the model, or hold no data.
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
    if not isinstance(options, DiagnosisOptions | None):
        raise GroundedError(f"options must be DiagnosisOptions(...), got a {type_of(options)}")
    options, tick = options or DiagnosisOptions(), Stages(progress, _done, open_ended=True)
    model = subject.model if isinstance(subject, Task) else subject
    if model.n + model.m > MOST_NAMES:
        raise GroundedError(
            f"model '{model.name}' has {model.n} states and {model.m} inputs; a diagnosis takes at "
            f"most {MOST_NAMES} of both together, since each may affect each: diagnose a model of "
            "the part where the gap is"
        )
    tick("instruments")
    shares = share_of(trials), share_of(compare)
    trials, copies = counted_once(shares[0].trials)
    compare, more = counted_once(shares[1].trials)
    copies += more
    exact = bool(copies) and not (scattered(trials) or scattered(compare))
    first = sum(trial.known_steps >= 2 for trial in trials)
    data, looked = sound_data(
        subject,
        [*trials, *compare],
        hidden=options.hidden,
        one_message=options.one_message,
        first=len(trials) if compare else None,
        interpolated_s=options.interpolated_s,
    )
    trials, model = looked.trials, data.model
    known = limits(data, looked.left_out)
    told = filter(None, [share.sentence for share in shares])
    known = replace(known, sentences=(*known.sentences, *copies, *told))
    tick("candidates")
    uncertain = Predictor(data)
    with np.errstate(all="ignore"):
        search = HypothesisSearch(data, ())
        null = search.refined([search.fresh(Hypothesis())], TO_THE_TOP)
        if null:
            data = replace(data, model=held(uncertain, null[0]))
            model = without_others(data, options.but, options.library)
            data = replace(data, model=model)
    settled, late = {*options.but, *looked.settled}, options.delays
    settled |= {f"sensor_delay:{name}" for name in options.one_message}
    offered = list(options.library.candidates(data.model, data.scales))
    names = {effect.name for effect in offered}
    if delay in options.library.families:  # those of the inputs that moved in earlier trials
        more = [name for name in late if name not in names]
        offered += [options.library.effect(name, data.model, data.scales) for name in more]
    shown = knowable(data, [e for e in offered if e.name not in settled], (*late,))
    candidates = tuple(
        _again(effect, late[effect.name], data) if effect.name in late else effect
        for effect in shown
        if effect.name not in settled
    )
    joints = options.library.joints(data.model, data.scales)
    joints = knowable(data, [e for e in joints if e.name not in settled])
    limit = options.max_effects or MOST_EFFECTS
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
    many = len(best.hypothesis.effects)  # may exceed the usual number if it has all joints
    most = min(limit, many + 1 if many > USUAL_EFFECTS else USUAL_EFFECTS)
    used = [trial for trial in trials if trial.known_steps >= 2]
    task = subject if isinstance(subject, Task) else None
    ruler = Ruler(search.predictor, options.origin)
    decision: Decision | None = None
    cut_short = False

    def found_so_far() -> str:
        return so_far(search, most, decision.fit.hypothesis.names if decision else None)

    # While a gap remains, search again without the leader, then for one more effect; decide anew.
    with np.errstate(all="ignore"), interruptible(found_so_far), running(engine, copied=copied):
        try:
            tick("predict")
            decision, restarts = decide(search, ruler), len(candidates) > PAIR
            while decision.gap or options.max_effects:
                before, size = decision.fit, len(decision.fit.hypothesis.names)
                again = bool(restarts and decision.gap and decision.leader)
                other = decision.gap and 0 < size < most and before is not search.of_size(size)[0]
                if not (again or other or (most < limit and (options.max_effects or size >= most))):
                    break
                tick.beside = "one more effect; Ctrl-C keeps what was found"
                tick("more effects")
                if again:
                    restarts = False
                    regrown(search, decision.leader, max(size, PAIR))
                elif other:
                    grown(search, before, size + 1)
                else:
                    most += 1
                    grown(search, search.chosen(most), most)
                decision = decide(search, ruler)
                if not again and not ruler.gain(before, decision.fit).clear:
                    break
        except KeyboardInterrupt:
            if decision is None:
                raise
            cut_short, tick.beside = True, ""
        tick("leftover")
        adopted = (*options.but, *options.delays)
        written = Writer(
            decision, ruler, known, adopted, options.horizon, most, tick, task, used, first, exact,
            uncertain,
        )  # fmt: skip
        groups = [k < first for k in range(data.count)]
        apart = compared(search, decision.fit, groups) if compare else None
        found = written.diagnosis(apart)
        said = with_faults(found.verdict, looked.findings)
        said = interrupted(said) if cut_short else said
        delays = _sensor_delays(found, data.model, options.but)
        older = late_as_positions(looked.findings, delays, options.but)
        return replace(found, verdict=said, preflight=(*looked.findings, *older))


def _sensor_delays(found: Diagnosis, model: Model, adopted: Collection[str]) -> dict[str, float]:
    """Return the delays of sensors that are part of the model or claimed, by effect [s]."""
    late = [name for name in adopted if name.startswith(SENSOR_DELAY)]
    known = {name: model.params[param_name(name, "d")].value for name in late}
    for row in found.ranking:
        if row.claimed and row.effect.startswith(SENSOR_DELAY):
            known[row.effect] = known.get(row.effect, 0.0) + row.values["d"]
    return known


def _again(effect: Effect, known: float, data: Data) -> Effect:
    """Return an adopted delay as a change of it, bounded so that the total is not negative."""
    late = data.latency[[data.model.input_names.index(name) for name in effect.site.targets]]
    return delay_again(effect, known, float(late.min()))


PAIR = 2  # effects at least that are sought without the leader
MOST_NAMES = 50  # 36 states and 12 inputs already give 1,649 effects, each of which is filtered
# The least share of a diagnosis that was done when it scanned for the k-th time or reached a stage,
# in nine blind cases of four systems (7 s in the mean).
SCANS = (0.05, 0.10, 0.19, 0.29, 0.35, 0.43, 0.50)
REACHED = {"more effects": 0.35, "predict": 0.76, "leftover": 0.83, "gap": 0.87, "utility": 0.96}


def _done(stage: str, time: int) -> float:
    """Return the least share of a diagnosis that is done when a stage begins for the k-th time."""
    if stage == "scan":
        return SCANS[min(time, len(SCANS)) - 1]
    return REACHED.get(stage, 0.0)
