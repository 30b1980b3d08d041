"""START HERE: the paper's algorithm as a function of stored trials.

Abbeel, Quigley & Ng, "Using Inaccurate Models in Reinforcement Learning", ICML 2006, section 3.
The idea: the REAL system evaluates the policy; the crude model only supplies the direction in which
to change it. A bias makes the model replay the last trial exactly, so that its derivatives are
taken along the true states.

    f_t^(i+1)(s, a) = f_t(s, a) + s_{t+1}^(i) - f_t(s_t^(i), a_t^(i))

| step | paper                                          | here                                    |
|------|------------------------------------------------|-----------------------------------------|
| 1, 2 | optimal policy of the crude model              | `first_policy` (`first_guess`, `ddp`)   |
| 3    | run it, record the trial                       | the user: `run`, `ingest`               |
| 4    | add a bias to the ORIGINAL model               | `bias.ground`                           |
| 5    | direction d from algorithm A in that model     | `making.direction` (`mispredictions`)   |
| 6    | theta + alpha d, line search on the real system| `Policy.toward`, `step_size`            |
| 7    | none improves: return the current policy       | `standing`                              |

`propose` is a pure function: the same candidates and trials give the same next candidate, bit for
bit. `ask_tell` has the loop around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.checks import list_of, of_type, refused
from grounded.errors import GroundedError
from grounded.findings import found
from grounded.model import Model
from grounded.search.candidate import BY_STEP, Candidate, Tried
from grounded.search.difference import one_trial_error
from grounded.search.making import About, Maker
from grounded.search.planner import Planner
from grounded.search.standing import (
    DIAGNOSE,
    Ending,
    Phase,
    Proposal,
    Standing,
    ended,
    let_down,
    standing,
)
from grounded.search.step_size import SearchOptions, Step, losers_of
from grounded.task import Task
from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.search.first_policy import Tick


def propose(
    task: Task,
    candidates: Sequence[Candidate],
    trials: Sequence[Trial],
    options: SearchOptions,
    *,
    identity: str = "",
    planner: Planner | None = None,
    refit: Callable[[Task, Sequence[Trial]], Model] | None = None,
    tick: Tick | None = None,
) -> Proposal:
    """Return what to run next: the outstanding candidate, a new one, or nothing.

    This is a pure function of its arguments; `Search` keeps the candidates and trials for you.

    Args:
        task: the manoeuvre and the crude model; the task judges the trials.
        candidates: the candidates proposed so far, in order.
        trials: the trials so far, in order; `Trial.candidate` says which candidate was run.
        options: settings of the search.
        identity: id of a new candidate; by default the next number, such as "c0003".
        planner: plans with a model that has adopted effects; None for the task's own model.
        refit: with `options.refit`, function (task, trials) -> model with fitted parameters; None
            for `grounded.fit`.
        tick: called with a line of progress while planning.

    Returns:
        A `Proposal`: its `candidate` is None if the search has ended, and its `standing` says why.

    Raises:
        GroundedError: if the model gives no plan to start from (the message says where it fails),
            or no weight of the reward is above 0.
    """
    of_type("task", task, Task)
    of_type("options", options, SearchOptions)
    reward = task.reward
    if not any(w.any() for w in (reward.state, reward.terminal, reward.input, reward.input_change)):
        raise refused("plan.no_weight", state=task.model.state_names[0])
    candidates = list_of(candidates, Candidate, "candidates")
    trials = list_of(trials, Trial, "trials")
    planner = planner or Planner(task, task)
    fingerprint = planner.fingerprint

    # Steps 3, 6 and 7: where the search stands by the trials of the real system.
    now = standing(task, candidates, trials, options, fingerprint)
    if now.phase is not Phase.PROPOSE:
        return Proposal(now, now.outstanding, is_new=False)

    # The model: with parameters fitted to the trials, and z as wide as the policies that ran.
    if options.refit and now.incumbent is not None:
        planner = planner.with_model((refit or refitted)(planner.plan, trials))
    planner = planner.feeding_back(tried.candidate.policy for tried in now.history)
    make = Maker(planner, now, identity or f"c{len(candidates) + 1:04d}", fingerprint)
    if now.incumbent is not None:
        return _improvement(make, now.incumbent, options)

    # Steps 1 and 2: the optimal policy of the crude model.
    policy, plan = planner.first_policy(now.caution, tick)
    if not plan.ok:
        raise refused("plan.none", why=plan.sentence)
    model = planner.plan.problem(exact=True)
    made = make.checked(make.candidate(policy, model, Step()))
    if plan.status == "converged":
        return made
    return replace(made, findings=(*made.findings, found("plan.not_optimal", why=plan.sentence)))


def refitted(task: Task, trials: Sequence[Trial]) -> Model:
    """Return the task's model with parameters fitted to all trials without gaps.

    The fitted values are rejected if they predict held-out trials worse than the model's own.
    """
    from grounded.fit import fit

    names = task.model.state_names
    whole = [t for t in trials if t.finite_steps == t.steps and t.steps > 2]
    memory = names[len(whole[0].state_names) :] if whole else ()
    lifted = [
        replace(
            t,
            states=np.hstack([t.states, np.full((t.steps + 1, len(memory)), np.nan)]),
            state_names=(*t.state_names, *memory),
        )
        for t in whole
    ]
    try:
        found = fit(task, lifted, hidden=memory)
    except GroundedError:  # the model is not finite there, or no trial is long enough
        return task.model
    return task.model if found.worse else found.model


def _improvement(make: Maker, incumbent: Tried, options: SearchOptions) -> Proposal:
    """Steps 4 to 6: propose the first step, from the due one on, that gains in the model.

    Other candidates take precedence where they are due (`gentler`, `own_plan`). A step whose
    predicted run loses is skipped without a trial: d must satisfy
    U^(theta + alpha d) >= U^(theta) for some alpha (step 5).
    """
    if (made := make.gentler(incumbent)) is not None:
        return make.checked(made)

    # Steps 4 and 5, and the plan of a model that was changed since the best trial.
    about = About(make, incumbent, options)
    proposal = _step(about)
    proposal = about.own_plan(proposal) or proposal

    # Step 7: no step is worth a trial.
    if proposal is None:
        return Proposal(_ended(make, incumbent, about, options), None, False)
    noise = proposal.candidate and _below_noise(make, incumbent, proposal.candidate, options)
    return Proposal(noise, None, False) if noise else proposal


def _step(about: About) -> Proposal | None:
    """Return the due step, by the derivatives that promise most.

    Steps by derivatives corrected step by step go on with these.
    """
    make, incumbent, options = about.make, about.incumbent, about.options
    base, due, by_step = incumbent.candidate, make.now.step, None
    assert due is not None
    again = options.due(make.now.history, incumbent, make.fingerprint, BY_STEP)
    if again is not None:
        stepping = About(make, incumbent, options, BY_STEP)
        by_step = stepping.step_from(again) if stepping.corrected else None
    if by_step is None or by_step.candidate is None:
        return about.step_from(due)
    if base.way == BY_STEP and base.model == make.fingerprint:
        return by_step
    found = about.step_from(due)
    gain = found.candidate.predicted_gain if found and found.candidate else -math.inf
    return found if gain >= by_step.candidate.predicted_gain else by_step


def _below_noise(
    make: Maker, best: Tried, made: Candidate, options: SearchOptions
) -> Standing | None:
    """Return the ended search if a step lost and the next promises less than its trial can show.

    Else a search under noise goes on for as long as the model promises anything. None: it goes on,
    as it does before a measured loss (a failed run is none), since many small gains add up, and if
    the best one's runs scatter by as much as they cost.
    """
    measured = [tried for tried in make.now.history if not tried.crashed]
    lost = losers_of(measured, best.candidate.id, make.fingerprint)
    error = one_trial_error(best, options.repeats)
    gain = made.promised_over(best)
    if not (options.damps and lost and made.grounded and gain < error):
        return None
    if gain > 0 and best.is_unsteady:
        return None
    return _no_step(make, best, Ending.BELOW_NOISE, gain=gain if gain > 0 else None, error=error)


def _ended(make: Maker, incumbent: Tried, rejected: About, options: SearchOptions) -> Standing:
    """Return the standing of a search in which no step is worth a trial, with the reason."""
    own = incumbent.candidate.id
    lost = losers_of(make.now.history, own, make.fingerprint)
    finite = [gain for gain in rejected.promised if np.isfinite(gain)]
    most, ask = max(finite, default=0.0), found("search.diagnose", then=DIAGNOSE)
    if rejected.promised and not finite:
        return ended(make.now, Ending.DIVERGES, found("search.diverges", own, best=own), ask)
    if most < -rejected.least and not lost:
        why = found("search.diverges", own, best=own, least=-most)
        return ended(make.now, Ending.EVERY_STEP_LOSES, why, ask)
    ending = Ending.NO_STEP if lost else Ending.NOTHING_PROMISED
    return _no_step(make, incumbent, ending, least=options.tolerance)


def _no_step(make: Maker, best: Tried, ending: Ending, **facts: float | None) -> Standing:
    """Return the ended search, with the steps from the best one that lost with this model."""
    own = best.candidate.id
    lost = len(losers_of(make.now.history, own, make.fingerprint)) or None
    why = found("search.no_step", own, best=own, lost=lost).also(**facts)
    return let_down(ended(make.now, ending, why), make.fingerprint)
