"""Where the search stands: DERIVED from candidates and stored trials, never kept beside them.

The real system is run by people, so the paper's loop can't be a while loop. Candidates in the order
in which they were proposed, and the trials that came back, say all there is to know:

    the incumbent    the best candidate so far, pi_theta^(i); its trials measure the next bias
    outstanding      the candidate that was proposed and has not been run often enough
    tried            the steps from the incumbent that did not improve (step 6)
    in doubt         a loss that may be luck: the incumbent is run once more before it is believed

Two trials of one candidate that agree to the last bit say that the system is deterministic, unless
others of one candidate differ: nothing is run a second time from then on.

Same candidates and trials, same state: nothing depends on the clock or on the process that asks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

from grounded.errors import GroundedError, NextCommand
from grounded.result import Result, document
from grounded.search.candidate import Candidate, Slopes, Tried, Way
from grounded.search.certainty import error_between, judged, last_improvement
from grounded.search.step_size import Step, after_failure, after_success
from grounded.task import Task
from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.figures.figure import Figure

Phase = Literal["propose", "await-trial", "converged", "stopped"]
Ending = Literal[
    "",  # it goes on
    "nothing promised",  # the grounded model sees nothing more to gain
    "no step improved",  # step 7: real trials lost down to the smallest step
    "every step loses",  # in the grounded model already
    "too doubtful",  # all that is promised would be lost many times over by other models
    "model diverges",  # grounded on the best trial
    "crashed",  # every first policy
    "not allowed",  # by [limits] or [safety]
    "too little gained",  # by the last trials, for what they cost
    "trials used up",
]
BOLDER = 3  # factors of 10 below the damping that is due, tried where all from it on lose
OTHER_WAY = 2  # losses of "recorded inputs", which comes after all others, before it is given up
PATIENCE = 4  # candidates in a row that may gain less than the tolerance each
LOST = 2  # steps in a row without improvement that ask for a diagnosis
WILD = 100.0  # times its promise that a first trial's loss may be before it asks for one
MAX_CAUTION = 3  # times the first policy is designed again, ever more gently, after a crash


@dataclass(frozen=True)
class SearchOptions:
    """The [search] table of grounded.toml; docs/configuration.md says what each key means."""

    method: Literal["ddp", "policy-gradient"] = "ddp"
    step: Literal["damped", "full"] = "damped"
    refit: bool = False
    match_inputs: bool = True  # False: the paper's bias alone, see `bias`
    max_halvings: int = 6
    repeats: int = 1
    rerun_incumbent: bool = True  # see `certainty.in_doubt`
    max_trials: int = 40
    tolerance: float = 1e-3  # stop when the model predicts less relative gain than this

    def __post_init__(self) -> None:
        bounds = {"max_halvings": (0, 30), "repeats": (1, 100), "max_trials": (1, 100_000)}
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise GroundedError(
                    f"[search] {name} must be {low} to {high}, got {getattr(self, name)}"
                )
        if self.repeats > self.max_trials:
            raise GroundedError(
                f"[search] repeats = {self.repeats} is more than max_trials = {self.max_trials}"
            )
        if not 0 <= self.tolerance < 1:
            raise GroundedError(f"[search] tolerance must be in [0, 1), got {self.tolerance}")

    @property
    def damps(self) -> bool:
        """Whether steps are damped as well (see `step_size`), or only halved as in the paper."""
        return self.method == "ddp" and self.step == "damped"

    def first_step(self) -> Step:
        """The first step along a new direction when nothing is known of the model's promises."""
        return Step(damping=1.0 if self.damps else 0.0)

    def next_step(self, step: Step) -> Step | None:
        """The step after one that did not improve; None when the search has failed (step 7)."""
        return after_failure(step, self.max_halvings, damps=self.damps)

    def ways(self, incumbent: Candidate) -> tuple[Way, ...]:
        """The ways to make a direction, first the one that has made the incumbent."""
        if not (self.damps and self.match_inputs):
            return ("",)
        recorded = incumbent.way == "recorded inputs"
        return ("recorded inputs", "") if recorded else ("", "recorded inputs")

    def due(
        self,
        history: Sequence[Tried],
        incumbent: Tried,
        model: str,
        way: Way,
        slopes: Slopes | None = None,
    ) -> Step | None:
        """The step that is due from the incumbent in one way; None where it is exhausted.

        A direction belongs to one model, and to one kind of its slopes where that is known: what
        was learnt with another counts for nothing.
        """
        made = incumbent.candidate
        losers = losers_of(history, made.id, model, way)
        if slopes is not None:
            losers = [candidate for candidate in losers if candidate.slopes == slopes]
        if way != self.ways(made)[0] and (incumbent.standard_error > 0 or len(losers) >= OTHER_WAY):
            return None  # where trials scatter, one way is enough to be told from luck
        if losers:
            return self.next_step(Step(losers[-1].damping, losers[-1].alpha))
        base = next((t for t in history if t.candidate.id == made.base), None)
        if base is None or made.model != model or made.way != way or not self.damps:
            return self.first_step()
        real = incumbent.utility - base.utility
        return after_success(Step(made.damping, made.alpha), made.predicted_gain, real)

    def steps_from(self, step: Step | None) -> Iterator[Step]:
        """The step that is due, the more cautious ones after it, then bolder ones than it."""
        first = step
        while step is not None:
            yield step
            step = self.next_step(step)
        if first is not None and self.damps:
            yield from (Step(first.damping / 10.0**k) for k in range(1, BOLDER + 1))


@dataclass(frozen=True, eq=False, repr=False)
class Standing(Result):
    """Where the search stands, with the sentence that says it."""

    phase: Phase
    iteration: int  # accepted improvements so far
    incumbent: Tried | None
    outstanding: Candidate | None
    missing: int  # trials that the outstanding candidate still needs
    step: Step | None  # what to try next when a candidate is to be made
    way: Way
    caution: int
    history: tuple[Tried, ...]
    trials: int
    sentence: str
    ending: Ending = ""
    then: NextCommand | None = None  # what helps now, beside going on
    doubt: str = ""  # why a diagnosis helps more than the next trial

    @property
    def utilities(self) -> list[float]:
        """Utility of the model's policy, then after each accepted improvement."""
        return [t.utility for t in self.history if t.accepted]

    @property
    def outcome(self) -> str:
        """The phase in words: only a search whose model promises nothing more has converged."""
        if self.ending in ("", "nothing promised"):
            return {"propose": "going on", "await-trial": "waiting"}.get(self.phase, self.phase)
        return self.ending

    def verdict(self, tried: Tried) -> str:
        """What became of a candidate; one that will not get its trials any more has none."""
        return tried.verdict(tried.candidate is (self.outstanding or self.history[-1].candidate))

    def summary(self) -> str:
        """Its phase and the best candidate."""
        best = self.incumbent
        known = f"best {best.candidate.id}, utility {best.utility:.4g}" if best else "none yet"
        return f"{self.outcome}: trials {self.trials}, {known}"

    def to_json(self) -> dict[str, Any]:
        """The document of `grounded status --json`, with the whole history."""
        best = self.incumbent
        return document(
            phase=self.phase,
            iteration=self.iteration,
            best=best and {"candidate": best.candidate.id, "utility": best.utility},
            utilities=self.utilities,
            trials=self.trials,
            outstanding=self.outstanding.id if self.outstanding else None,
            missing=self.missing,
            sentence=self.sentence,
            ending=self.ending or None,
            certainty=last_improvement(self.history),
            history=[t.to_json() | {"verdict": self.verdict(t)} for t in self.history],
        )

    def figures(self) -> Sequence[Figure]:
        """Utility by candidate, and the step sizes."""
        from grounded.search.pictures import search_figure

        found = search_figure(self)
        return () if found is None else (found,)


def standing(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    model: str,
) -> Standing:
    """Steps 6 and 7 over stored trials.

    Args:
        task: judges the trials.
        candidates: in order of proposal.
        trials: in order of storage; those of no known candidate are ignored here.
        options: the [search] table.
        model: fingerprint of the task's model now; a direction belongs to one model.
    """
    history, incumbent, iteration = judged(task, candidates, trials, options, model)
    total = sum(len(t.trials) for t in history)
    now = Standing(
        phase="propose",
        iteration=iteration,
        incumbent=incumbent,
        outstanding=None,
        missing=0,
        step=None,
        way="",
        caution=0,
        history=history,
        trials=total,
        sentence="the model's own policy comes first",
    )
    if (awaited := _awaited(now, options, model)) is not None:
        return awaited
    if total + options.repeats > options.max_trials:
        used = "all" if total >= options.max_trials else f"{total} of"
        needs = f"; a candidate needs {options.repeats}" * (total < options.max_trials)
        sentence = f"{used} {options.max_trials} trials are used up{needs} ([search] max_trials)"
        return replace(now, phase="stopped", sentence=sentence, ending="trials used up")
    if incumbent is None:
        failed = sum(t.accepted is False for t in history)
        if failed > MAX_CAUTION:
            sentence = (
                f"the first policy crashed {failed} times, designed more gently each time: the "
                "model is too far off to start from; mend it (fit, diagnose) and propose again"
            )
            return replace(
                now,
                phase="stopped",
                sentence=sentence,
                ending="crashed",
                then=NextCommand("diagnose"),
            )
        now = replace(now, step=options.first_step(), caution=failed)
        if failed < LOST or history[-1].candidate.model != model:
            return now
        why = f"{failed} policies crashed in a row: a diagnosis may say what the model lacks"
        return replace(now, sentence=why, then=NextCommand("diagnose"), doubt=why)
    own = incumbent.candidate.id
    step, way = _next_step(history, incumbent, options, model)
    if step is None:
        sentence = (
            f"no step improved on {own} down to alpha = {2.0**-options.max_halvings:g}: "
            f"{own} is the result (step 7)"
        )
        return replace(now, phase="converged", sentence=sentence, ending="no step improved")
    if options.damps and (hardly := _hardly(history, options.tolerance, model)):
        ending, why = hardly
        why = f"{why}: {own} is the result"
        return replace(now, phase="converged", sentence=why, ending=ending)
    sentence = f"improve on {own} with {step}"
    if why := _suspicion(history, incumbent, model):
        then, sentence = NextCommand("diagnose"), f"{sentence}; {why}"
        return replace(now, step=step, way=way, sentence=sentence, then=then, doubt=why)
    return replace(now, step=step, way=way, sentence=sentence)


def _hardly(history: tuple[Tried, ...], tolerance: float, model: str) -> tuple[Ending, str] | None:
    """The ending where the last candidates of this model gained too little for what they cost.

    Too little is less than the tolerance each, or less in all than the standard error of that gain,
    where repeats tell it: a search under noise would go from one lucky run to the next.
    """
    before = [t for t in history[:-PATIENCE] if t.accepted]
    last = history[-PATIENCE:]
    if not before or any(t.candidate.model != model for t in last):
        return None
    old, best = before[-1], [t for t in history if t.accepted][-1]
    gained = best.utility - old.utility
    if gained == 0.0:
        return "no step improved", f"the last {PATIENCE} candidates did not improve"
    told = f"the last {PATIENCE} candidates gained {gained:.3g} in all, less than"
    if gained < PATIENCE * tolerance * abs(best.utility):
        return "too little gained", f"{told} {100 * tolerance:g} % each ([search] tolerance)"
    error, known = error_between(old, best, history)
    if known and gained < error:
        return "too little gained", f"{told} its standard error, {error:.2g} by repeats"
    return None


def _suspicion(history: tuple[Tried, ...], incumbent: Tried, model: str) -> str:
    """Why a diagnosis helps more than the next trial, "" where nothing says so."""
    if history[-1].candidate.model != model:
        return ""  # it was changed since: the next trial tells what that was worth
    lost = 0
    for tried in history:
        lost = 0 if tried is incumbent or tried.accepted is None else lost + 1
    if lost >= LOST:
        return f"{lost} steps in a row did not improve: a diagnosis may say what the model lacks"
    if wild(incumbent):
        made = incumbent.candidate
        return (
            f"its trial gave {incumbent.utility:.4g} where the model promised "
            f"{made.predicted_utility:.4g}: a diagnosis may say what the model lacks"
        )
    return ""


def wild(tried: Tried) -> bool:
    """Whether a model's own policy did so much worse than promised that its bias says little."""
    predicted = tried.promised
    worse = predicted - tried.utility > WILD * max(abs(predicted), 1e-9)
    return bool(tried.utilities) and not tried.candidate.base and worse


def _awaited(now: Standing, options: SearchOptions, model: str) -> Standing | None:
    """The same, waiting for a trial; None where every candidate has its trials."""
    waiting = _waiting(now, model)
    doubt = next((t for t in now.history if t.in_doubt), None)
    if doubt is not None and now.incumbent is not None:
        made, missing = now.incumbent.candidate, 1
        sentence = (
            f"{doubt.candidate.id} lost to {made.id} by less than luck may do: {made.id} is "
            "waiting for another trial"
        )
    elif waiting is not None:
        made, missing = waiting.candidate, options.repeats - len(waiting.trials)
        sentence = f"{made.id} is waiting for {missing} trial{'s' * (missing > 1)}"
    else:
        return None
    return replace(now, phase="await-trial", outstanding=made, missing=missing, sentence=sentence)


def _waiting(now: Standing, model: str) -> Tried | None:
    """The latest candidate without its trials whose reason still stands.

    A trial may be set aside after a candidate was made of it: the crash for which a first policy
    is gentle, or the run that a step starts from.
    """
    undecided = {t.candidate.id for t in now.history if t.accepted is None}
    failed = sum(t.accepted is False for t in now.history)
    for tried in reversed(now.history):
        made = tried.candidate
        if tried.accepted is not None or made.model != model:
            return None
        if made.base not in undecided and (made.base or made.caution <= failed):
            return tried
    return None


def losers_of(
    history: Sequence[Tried], base: str, model: str, way: Way | None = None
) -> list[Candidate]:
    """The candidates from another one, planned in this model, that did not improve on it.

    Args:
        history: all candidates with their trials.
        base: the id of the one that they started from.
        model: fingerprint of the model.
        way: only those that were made so; None: all.
    """
    tried = [t for t in history if t.candidate.base == base and t.candidate.model == model]
    lost = [t.candidate for t in tried if t.accepted is False]
    return [c for c in lost if way is None or c.way == way]


def _next_step(
    history: tuple[Tried, ...], incumbent: Tried, options: SearchOptions, model: str
) -> tuple[Step | None, Way]:
    """Damping and alpha after what the trials have shown, and the way to make the direction."""
    ways = options.ways(incumbent.candidate)
    for way in ways:
        if (step := options.due(history, incumbent, model, way)) is not None:
            return step, way
    return None, ways[-1]
