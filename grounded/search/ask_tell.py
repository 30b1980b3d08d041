"""Steps 1 to 7 as a loop: ask for a candidate, run it on the real system, tell the trial.

    search = Search(task)
    while (candidate := search.ask()) is not None:
        search.tell(run(candidate))

A `Search` holds the candidates that were asked for and the trials that were told, nothing else;
where it stands is derived from them (`propose`, `standing`). `learn` is this loop for a real system
that is a function call.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, nearest
from grounded.policy import Policy
from grounded.search.candidate import Candidate, Tried
from grounded.search.improve import propose
from grounded.search.making import Proposal
from grounded.search.planner import Planner, planner_with
from grounded.search.standing import SearchOptions, Standing
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps

if TYPE_CHECKING:
    from grounded.effects import Library


class Search:
    """A search that is asked and told, without a disk.

    Args:
        task: the manoeuvre and the crude model.
        options: the [search] table; None: its defaults.
        candidates: those of a search that goes on, in the order in which they were asked for.
        trials: their trials, in the order in which they were told.
        planner: plans with a better model (`adopt`); None: with the task's own.
    """

    def __init__(
        self,
        task: Task,
        options: SearchOptions | None = None,
        *,
        candidates: Iterable[Candidate] = (),
        trials: Iterable[Trial] = (),
        planner: Planner | None = None,
    ) -> None:
        if not isinstance(task, Task):
            raise GroundedError(f"a Search needs a Task, got a {type(task).__name__}")
        self.task, self.options = task, options or SearchOptions()
        self.planner = planner or Planner(task, task)
        self._candidates, self._trials = list(candidates), list(trials)
        for trial in self._trials:
            self._fits(trial)
        self._planned: Proposal | None = None  # what follows from them, once that is asked for

    def __repr__(self) -> str:
        return f"<Search: candidates {len(self._candidates)}, trials {len(self._trials)}>"

    def _repr_html_(self) -> str:
        """Where it stands, for Jupyter."""
        return self.standing._repr_html_()

    def plot(self) -> Any:
        """Utilities of the candidates as a Plotly figure; see `Result.plot`."""
        return self.standing.plot()

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The candidates that were asked for."""
        return tuple(self._candidates)

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The trials that were told."""
        return tuple(self._trials)

    @property
    def proposal(self) -> Proposal:
        """What `ask` would return, or why there is nothing more to run."""
        if self._planned is None:
            whole = [interpolate_gaps(trial).trial for trial in self._trials]
            self._planned = propose(
                self.task, self._candidates, whole, self.options, planner=self.planner
            )
        return self._planned

    @property
    def standing(self) -> Standing:
        """Where the search stands; plans the next candidate, which alone tells whether it ends."""
        return self.proposal.standing

    @property
    def best(self) -> Tried | None:
        """The best candidate so far with its trials; None before the first whole trial."""
        return self.standing.incumbent

    @property
    def policy(self) -> Policy | None:
        """The best policy so far; None before the first whole trial."""
        return self.best.candidate.policy if self.best else None

    def ask(self) -> Candidate | None:
        """The candidate to run next, the same one until its trial is told; None at the end."""
        proposal = self.proposal
        if proposal.candidate is not None and proposal.is_new:
            self._candidates.append(proposal.candidate)
            self._planned = None
        return proposal.candidate

    def adopt(
        self,
        effects: Mapping[str, Mapping[str, float]],
        params: Mapping[str, float] | None = None,
        library: Library | None = None,
    ) -> Search:
        """The search from here on with a better model, whatever memory its effects have.

        Args:
            effects: quantities by effect, in the order in which they act, `joining` of a diagnosis
                of this search's task and trials; in place of those adopted before.
            params: the model's own parameters that were calibrated beside them.
            library: where the families are; None: the built-in ones.

        Raises:
            GroundedError: for an unknown effect or parameter, or a quantity that is missing.
        """
        task = self.task.with_model(self.task.model.with_values(params or {}))
        planner = planner_with(task, list(effects.items()), library)
        return Search(
            task, self.options, candidates=self._candidates, trials=self._trials, planner=planner
        )

    def _fits(self, trial: Trial) -> None:
        if not isinstance(trial, Trial):
            raise GroundedError(
                f"a robot returns a Trial of what it ran, got one of type {type(trial).__name__}"
            )
        model = self.task.model
        has = (trial.state_names, trial.input_names, trial.dt)
        expected = (model.state_names, model.input_names, self.task.dt)
        if has != expected:
            raise GroundedError(
                f"a trial of this task has states, inputs and dt {expected}, found {has}"
            )

    def tell(self, trial: Trial) -> None:
        """Adds a real trial.

        Args:
            trial: its `candidate` says what was run; without one, it was the outstanding candidate.
                Short gaps (NaN) are bridged for the search, and stay gaps in `trials`.

        Raises:
            GroundedError: for a trial of no candidate of this search, of other states or inputs, or
                on another time grid.
        """
        ids = [c.id for c in self._candidates]
        self._fits(trial)
        if not trial.candidate:
            waiting = self.standing.outstanding
            if waiting is None:
                raise GroundedError(
                    "no candidate is waiting for a trial: ask() for one first, or name the one "
                    "that was run as the trial's `candidate`"
                )
            trial = replace(trial, candidate=waiting.id)
        if trial.candidate not in ids:
            raise GroundedError(
                f"this search has no candidate '{trial.candidate}': {nearest(trial.candidate, ids)}"
            )
        self._trials.append(trial)
        self._planned = None


def learn(
    task: Task,
    run: Callable[[Candidate], Trial],
    options: SearchOptions | None = None,
    *,
    max_iterations: int | None = None,
    check: bool = True,
) -> Search:
    """Runs a search to its end on a real system that is a function call.

    Args:
        task: the manoeuvre and the crude model.
        run: executes a candidate once and returns its trial; its `candidate` field is set here.
        options: the [search] table; None: its defaults.
        max_iterations: ends after so many accepted improvements.
        check: look whether the columns of the first trial are what the model calls by their names.

    Raises:
        GroundedError: if they are in other units, turned or exchanged, as far as they tell: every
            further plan would be made of such trials.
    """
    search = Search(task, options)
    while True:
        proposal = search.proposal
        done = max_iterations is not None and proposal.standing.iteration >= max_iterations
        if proposal.candidate is None or (done and proposal.is_new):
            return search
        candidate = search.ask()
        assert candidate is not None
        trial = run(candidate)
        search.tell(replace(trial, candidate=candidate.id) if isinstance(trial, Trial) else trial)
        if check and len(search.trials) == 1:
            _check_columns(task, search.trials[0])


def _check_columns(task: Task, trial: Trial) -> None:
    """Raises for a trial that its own columns, or the model, say is in other units."""
    from grounded.instruments.finding import in_the_log
    from grounded.instruments.sound_trials import sound_trials

    first = "the first trial can't be learned from"
    mend = "Mend the function that runs the robot, or pass check=False where this is mistaken"
    try:
        looked = sound_trials(task.model, [replace(interpolate_gaps(trial).trial, id="")])
    except GroundedError as error:
        said = str(error).replace("in trial number 1 ", "")
        raise GroundedError(f"{first}: {said}. {mend}") from None
    if odd := in_the_log(looked.findings):
        said = "; ".join(f"{one.signal} {one.finding}" for one in odd)
        raise GroundedError(f"{first}: {said}. {mend}")
