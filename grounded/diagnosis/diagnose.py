"""START HERE: the sim-to-real gap, diagnosed. Trials and a crude model in, a verdict out.

sound_trials      the instruments, from their signals alone: corrected first  (instruments)
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
verdict           all of it in sentences; `writer` puts all together, `report` is it as data
excitation        what to run next, where two explanations tie
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from grounded.diagnosis.hypotheses.attribution import USUAL_EFFECTS, attribute, grown, so_far
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import Data, prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.report import Diagnosis
from grounded.diagnosis.validation.agreement import compared
from grounded.diagnosis.validation.decide import decide
from grounded.diagnosis.validation.limits import (
    counted_once,
    held,
    knowable,
    limits,
)
from grounded.diagnosis.validation.motions import without_others
from grounded.diagnosis.validation.ruler import Ruler
from grounded.diagnosis.verdict import MOST_EFFECTS, with_faults
from grounded.diagnosis.writer import Writer
from grounded.effects import Effect, Library
from grounded.effects.actuator import delay_again
from grounded.engine import Engine, running, steady
from grounded.errors import GroundedError
from grounded.instruments.lag import whole_steps
from grounded.instruments.sound_trials import sound_trials
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
        delays: those that were adopted [s], by the names of their effects, which the task's latency
            holds: they may have to be longer or shorter.
        origin: the task before anything was adopted: what matters is measured by what its model
            misses, in the second diagnosis as in the first.
    """

    library: Library = field(default_factory=Library)
    max_effects: int | None = None
    horizon: float = 1.0
    hidden: tuple[str, ...] = ()
    but: Collection[str] = ()
    delays: Mapping[str, float] = field(default_factory=dict)
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
    looked = sound_trials(subject, [*trials, *compare], options.hidden)
    trials = looked.trials
    data = prepare(model, trials, latency, past, options.hidden)
    filters = {model.state_names.index(name): tau for name, tau in looked.filters.items()}
    moved = [f for f in looked.findings if f.corrected and f.kind == "delay"]
    between = {f.signal for f in moved if not whole_steps(f.delay_s / data.dt)}
    data = replace(data, filters=filters, between=frozenset(between))
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
    offered = [
        _again(effect, options.delays[effect.name], data)
        if effect.name in options.delays
        else effect
        for effect in options.library.candidates(data.model, data.scales)
    ]
    settled = {*options.but, *looked.settled}
    candidates = knowable(data, [e for e in offered if e.name not in settled])
    joints = options.library.joints(data.model, data.scales)
    joints = knowable(data, [e for e in joints if e.name not in settled])
    with running(engine):
        search, best = attribute(
            data, candidates, max_effects=options.max_effects, tick=tick, joints=joints
        )
    many = len(best.hypothesis.effects)  # of all joints, beside which one more was looked for
    most = options.max_effects or (many + 1 if many > USUAL_EFFECTS else USUAL_EFFECTS)
    used = [trial for trial in trials if trial.known_steps >= 2]
    task = subject if isinstance(subject, Task) else None
    written: Writer | None = None

    def found_so_far() -> str:
        return so_far(search, most, written.claims.names if written else None)

    here = interruptible(found_so_far)
    with np.errstate(all="ignore"), here, running(engine):
        while True:
            tick("predict")
            ruler = Ruler(search.predictor, options.origin)
            decision = decide(search, best, ruler, most)
            tick("leftover")
            writer = Writer(
                decision,
                ruler,
                known,
                options.but,
                options.horizon,
                most,
                tick,
                task,
                used,
                exact,
                uncertain,
            )
            if written and not writer.worth_more_than(written):
                written.most = most  # one more was looked for
                break
            written = writer
            if options.max_effects or not (most < MOST_EFFECTS and writer.unfinished):
                break
            most += 1
            tick("more effects")
            best = grown(search, best, most)
        decision, found = written.decision, written.diagnosis()
        groups = [k < first for k in range(data.count)]
        apart = compared(search, decision.fit, groups) if compare else None
        return replace(
            found,
            verdict=with_faults(found.verdict, looked.findings),
            preflight=looked.findings,
            changed=apart.changed if apart else None,
            unchanged=apart.unchanged if apart else (),
        )


def _again(effect: Effect, known: float, data: Data) -> Effect:
    """An adopted delay as a change of it: no command arrives before it was sent."""
    late = data.latency[[data.model.input_names.index(name) for name in effect.site.targets]]
    return delay_again(effect, known, float(late.min()))


MOST_NAMES = 50  # of 36 and 12 come 1,649 effects, of 20 and 100 as many; each is filtered
USUAL = 160  # stages of a diagnosis, and hypotheses that are refined together
FIRST_LOOK = 6  # iterations of the fit by whose noise the parameters are found identifiable
