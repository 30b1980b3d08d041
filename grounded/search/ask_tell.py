"""Steps 1 to 7 as a loop: ask for a candidate, run it on the real system, tell the result.

    search = Search(task)
    while (candidate := search.ask()) is not None:
        search.tell(run(candidate))

A `Search` stores only the candidates it has proposed and the trials it was given; its state is
derived from them (`propose`, `standing`). `learn` runs this loop for a real system that can be
called as a function.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.accounts.finding import UnusableTrials, in_the_log
from grounded.accounts.reported import scaled
from grounded.accounts.returned import Kind, suspicion, unit_by_factor
from grounded.accounts.sound_trials import sound_trials
from grounded.checks import known, list_of, of_type, refused, same_dt, same_names, wrong
from grounded.errors import GroundedError
from grounded.findings import Finding, Weight, found
from grounded.model import Model
from grounded.policy import Policy
from grounded.search.candidate import Candidate, Tried
from grounded.search.improve import propose
from grounded.search.planner import Planner, planner_with
from grounded.search.standing import Proposal, Standing
from grounded.search.step_size import SearchOptions
from grounded.task import Task
from grounded.trial import Trial, interpolate_gaps

if TYPE_CHECKING:
    from grounded.effects import Library


class TrialRefused(GroundedError):
    """Raised by `learn` for a trial that is not its candidate's run.

    Args:
        why: what is wrong with the trial: correct the function that runs the robot, or pass
            `check=False` if it is mistaken.
        search: the search without this trial; `ask` and `tell` continue it.
    """

    def __init__(self, why: Finding, search: Search) -> None:
        super().__init__(why.what)
        self.finding = why.weighing(Weight.REFUSE)
        self.search = search


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
        of_type("task", task, Task)
        if options is not None:
            of_type("options", options, SearchOptions)
        self.task, self.options = task, options or SearchOptions()
        self.planner = planner or Planner(task, task)
        self._candidates = list_of(candidates, Candidate, "candidates")
        self._trials = list_of(trials, Trial, "trials")
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
            GroundedError: for an unknown effect or parameter, a value outside a parameter's
                bounds, or a missing quantity.
        """
        if not isinstance(effects, Mapping) or not all(
            isinstance(values, Mapping) for values in effects.values()
        ):
            raise wrong("effects", effects, must="dict", like="Diagnosis.joining")
        if not isinstance(params, Mapping | None):
            raise wrong("params", params, must="dict", like="{'mass': 1.2}")
        model, values = self.task.model, params or {}
        for name in values.keys() & model.params.keys():
            model.params[name].within(name, values[name])
        task = self.task.with_model(model.with_values(values))
        planner = planner_with(task, list(effects.items()), library)
        return Search(
            task, self.options, candidates=self._candidates, trials=self._trials, planner=planner
        )

    def _fits(self, trial: Trial) -> None:
        given: Any = trial
        if not isinstance(given, Trial):
            do = "read" if isinstance(given, str | Path) else None
            raise wrong("the trial", got=f"a {type(given).__name__}", must="trial", do=do)
        same_names("the trial", "states", trial.state_names, self.task.model.state_names)
        same_names("the trial", "inputs", trial.input_names, self.task.model.input_names)
        same_dt("the trial", trial.dt, self.task.dt)

    def tell(self, trial: Trial) -> None:
        """Add a trial of the real system; warn if it is evidently not its candidate's run.

        Its commands are compared with what the policy sends on its states, and the columns of the
        first trial with each other. A trial that counts as a crash is reported as well.

        Args:
            trial: the recorded run. Its `candidate` is the id of the candidate that was run; if it
                is empty, the outstanding candidate is assumed. Gaps (NaN) of up to 1 s are
                interpolated for the search; `trials` keeps them.

        Raises:
            GroundedError: if the trial's candidate is not one of this search, or its states, inputs
                or dt differ from the task's.
        """
        self._add(trial)
        self._check_last(refuse=False)

    def _check_last(self, *, refuse: bool) -> None:
        """Warn of what is wrong with the last trial, or forget and refuse one that is odd."""
        trial = self._trials[-1]
        odd = odd_trial(self.task, self._candidates, trial, first=len(self._trials) == 1)
        if odd and refuse:
            del self._trials[-1]
            raise TrialRefused(odd, self)
        if why := odd or crashed(self.task, trial):
            warnings.warn(f"{trial.candidate}: {why.what}", stacklevel=3)

    def _add(self, trial: Trial) -> None:
        ids = [c.id for c in self._candidates]
        self._fits(trial)
        if not trial.candidate:
            waiting = self.standing.outstanding
            if waiting is None:
                raise refused("search.none_waits")
            trial = replace(trial, candidate=waiting.id)
        known("candidate", [trial.candidate], ids, "this search")
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
        check: check that the commands of each trial are those of its candidate on its states, and
            the columns of the first for wrong units, signs or exchanged names; warn of crashes.

    Returns:
        The finished search; `best` and `policy` are its result, `standing.sentence` says why it
        ended.

    Raises:
        TrialRefused: if that check finds an error, since all further plans would rest on wrong
            data. Its `search` has the trials before.
        GroundedError: as `Search.ask` and `Search.tell`.
    """
    search = Search(task, options)
    if not callable(run):
        raise wrong("run", got=f"a {type(run).__name__}", must="call")
    if not isinstance(max_iterations, int | None):
        raise wrong("max_iterations", max_iterations, must="whole")
    while True:
        proposal = search.proposal
        done = max_iterations is not None and proposal.standing.iteration >= max_iterations
        if proposal.candidate is None or (done and proposal.is_new):
            return search
        candidate = search.ask()
        assert candidate is not None
        trial: Any = run(candidate)
        if not isinstance(trial, Trial):
            got = f"a {type(trial).__name__}"
            raise wrong("what run(candidate) returns", got=got, must="trial")
        search._add(replace(trial, candidate=candidate.id))
        if check:
            search._check_last(refuse=True)


# --- checks of a trial that was told: those of `grounded ingest`, worded for a program ------------


def odd_trial(
    task: Task, candidates: Sequence[Candidate], trial: Trial, *, first: bool
) -> Finding | None:
    """Return why a trial, as it was told, can't be a run of its candidate, if it can't.

    The columns of the first one are also checked against each other and the model.
    """
    whole, model = interpolate_gaps(trial).trial, task.model
    own = next(one for one in candidates if one.id == trial.candidate)
    first_row = np.concatenate([trial.states[0], *trial.inputs[:1]])
    signals = (*trial.state_names, *trial.input_names)
    each = zip(signals, np.isfinite(first_row), strict=False)
    if whole.finite_steps < 1 and (lacks := [name for name, finite in each if not finite]):
        return found("given.value", *lacks, must="finite")
    seen = suspicion(task, whole, own, candidates)
    units = [(one.names, one.by) for one in seen.stories if one.kind is Kind.UNIT]
    names, by = units[0] if units else ((), 1.0)
    if unit := unit_by_factor(model, names, by):  # the columns may agree with each other
        return scaled(model, names, 1 / by, unit).also(ran=own.id)
    columns = _odd_columns(model, whole) if first else None
    if columns or not (names or seen.why):
        return columns
    return scaled(model, names, 1 / by).also(ran=own.id) if names else seen.why


def crashed(task: Task, trial: Trial) -> Finding | None:
    """Return that a trial counts as a crash, if it does."""
    if np.isfinite(task.utility(whole := interpolate_gaps(trial).trial)):
        return None
    until, large = min(whole.finite_steps, whole.steps), whole.finite_steps >= task.horizon
    facts: dict[str, Any] = {"steps": max(until, 0), "horizon": task.horizon, "large": large}
    return found("run.failed", trial.candidate, **facts)


def _odd_columns(model: Model, trial: Trial) -> Finding | None:
    """Return what is wrong with the columns of a trial, in units, signs or names."""
    try:
        looked = sound_trials(model, [replace(trial, id="")])
    except UnusableTrials as error:
        return error.findings[0]
    for one in in_the_log(looked.findings):
        return scaled(model, [one.signal], one.scale, "" if one.kind == "sign" else "deg")
    return None
