"""Steps 1 to 7 as a loop: ask for a candidate, run it on the real system, tell the result.

    search = Search(task)
    while (candidate := search.ask()) is not None:
        search.tell(run(candidate))

A `Search` stores only the candidates it has proposed and the trials it was given; its state is
derived from them (`propose`, `standing`). `learn` runs this loop for a real system that can be
called as a function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from grounded.errors import GroundedError, nearest
from grounded.policy import Policy
from grounded.search.candidate import Candidate, Tried
from grounded.search.improve import propose
from grounded.search.planner import Planner, planner_with
from grounded.search.proposal import Proposal
from grounded.search.standing import SearchOptions, Standing
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps

if TYPE_CHECKING:
    from grounded.effects import Library


class Search:
    """A search with an ask-and-tell interface, kept in memory.

    `ask` returns the candidate to run next; `tell` adds the trial of its run.

    Args:
        task: the manoeuvre and the crude model.
        options: settings of the search; None for the defaults.
        candidates: candidates of an earlier search to continue, in the order of their proposal.
        trials: their trials, in the order in which they were told.
        planner: plans with a better model (see `adopt`); None for the task's own model.

    Raises:
        GroundedError: if `task` is not a `Task`, or a trial does not fit it.
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
        self._planned: Proposal | None = None  # cache of `proposal`

    def __repr__(self) -> str:
        return f"<Search: candidates {len(self._candidates)}, trials {len(self._trials)}>"

    def _repr_html_(self) -> str:
        """Return the standing as an HTML table, for Jupyter."""
        return self.standing._repr_html_()

    def plot(self) -> Any:
        """Return a Plotly figure of the candidates' utilities; see `Result.plot`."""
        return self.standing.plot()

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """The candidates proposed so far, in order."""
        return tuple(self._candidates)

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The trials told so far, in order."""
        return tuple(self._trials)

    @property
    def proposal(self) -> Proposal:
        """The proposal that `ask` would return a candidate of; computed on first use."""
        if self._planned is None:
            whole = [interpolate_gaps(trial).trial for trial in self._trials]
            self._planned = propose(
                self.task, self._candidates, whole, self.options, planner=self.planner
            )
        return self._planned

    @property
    def standing(self) -> Standing:
        """The state of the search. Plans the next candidate, which decides whether it has ended."""
        return self.proposal.standing

    @property
    def best(self) -> Tried | None:
        """The best candidate so far with its trials; None before the first complete trial."""
        return self.standing.incumbent

    @property
    def policy(self) -> Policy | None:
        """The best policy so far; None before the first complete trial."""
        return self.best.candidate.policy if self.best else None

    def ask(self) -> Candidate | None:
        """Return the candidate to run next, or None if the search has ended.

        Repeated calls return the same candidate until its trial is told.

        Raises:
            GroundedError: if the model gives no plan to start from.
        """
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
        """Return a search that continues from here with effects added to the model.

        Effects may have memory (a delay, a lag). This search is not changed.

        Args:
            effects: values of each effect's quantities by effect name, in the order in which the
                effects act, as in `Diagnosis.joining`. They replace effects adopted earlier.
            params: new values of the model's own parameters, calibrated with the effects.
            library: the library of effect families; None for the built-in families.

        Raises:
            GroundedError: for an unknown effect or parameter, or a missing quantity.
        """
        task = self.task.with_model(self.task.model.with_values(params or {}))
        planner = planner_with(task, list(effects.items()), library)
        return Search(
            task, self.options, candidates=self._candidates, trials=self._trials, planner=planner
        )

    def _fits(self, trial: Trial) -> None:
        if not isinstance(trial, Trial):
            raise GroundedError(f"expected a Trial of the run, got a {type(trial).__name__}")
        model = self.task.model
        has = (trial.state_names, trial.input_names, trial.dt)
        expected = (model.state_names, model.input_names, self.task.dt)
        if has != expected:
            raise GroundedError(
                f"a trial of this task has states, inputs and dt {expected}, found {has}"
            )

    def tell(self, trial: Trial) -> None:
        """Add a trial of the real system.

        Args:
            trial: the recorded run. Its `candidate` is the id of the candidate that was run; if it
                is empty, the outstanding candidate is assumed. Gaps (NaN) of up to 1 s are
                interpolated for the search; `trials` keeps them.

        Raises:
            GroundedError: if the trial's candidate is not one of this search, or its states, inputs
                or dt differ from the task's.
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
    """Run a search to its end on a real system that can be called as a function.

    Args:
        task: the manoeuvre and the crude model.
        run: executes a candidate once and returns the trial; its `candidate` field is set here.
        options: settings of the search; None for the defaults.
        max_iterations: stop after this many accepted improvements; None for no limit.
        check: check the columns of the first trial for wrong units, signs or exchanged names.

    Returns:
        The finished search; `best` and `policy` are its result, `standing.sentence` says why it
        ended.

    Raises:
        GroundedError: if that check finds an error, since all further plans would rest on wrong
            data, or as `Search.ask` and `Search.tell`.
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
    """Raise GroundedError if the trial's columns have wrong units, signs or exchanged names."""
    from grounded.instruments.finding import in_the_log
    from grounded.instruments.sound_trials import sound_trials

    first = "the first trial can't be used"
    mend = "Correct the function that runs the robot, or pass check=False if this is mistaken"
    try:
        looked = sound_trials(task.model, [replace(interpolate_gaps(trial).trial, id="")])
    except GroundedError as error:
        said = str(error).replace("in trial number 1 ", "")
        raise GroundedError(f"{first}: {said}. {mend}") from None
    if odd := in_the_log(looked.findings):
        said = "; ".join(f"{one.signal} {one.finding}" for one in odd)
        raise GroundedError(f"{first}: {said}. {mend}")
