"""START HERE: the paper's algorithm as a function of stored trials.

Abbeel, Quigley & Ng, "Using Inaccurate Models in Reinforcement Learning", ICML 2006, section 3.
The idea: let the REAL system evaluate the policy, and ask the crude model only which way to change
it. The model is made to replay the last trial exactly, so that its derivatives are taken along the
true states.

    f_t^(i+1)(s, a) = f_t(s, a) + s_{t+1}^(i) - f_t(s_t^(i), a_t^(i))

| step | paper                                          | here                                    |
|------|------------------------------------------------|-----------------------------------------|
| 1, 2 | optimal policy of the crude model              | `first_policy` (`first_guess`, `ddp`)   |
| 3    | run it, record the trial                       | people, robots: `run`, `ingest`         |
| 4    | add a bias to the ORIGINAL model               | `bias.ground`                           |
| 5    | direction d from algorithm A in that model     | `directions` (`mispredictions`)         |
| 6    | theta + alpha d, line search on the real system| `Policy.toward`, `step_size`            |
| 7    | none improves: return the current policy       | `standing`                              |

`propose` is a pure function: the same candidates and trials give the same next candidate, bit for
bit. `ask_tell` is the loop around it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from grounded.errors import GroundedError, NextCommand
from grounded.model import Model
from grounded.result import figure
from grounded.search.candidate import Candidate, Tried
from grounded.search.making import About, Maker, Proposal
from grounded.search.planner import Planner
from grounded.search.standing import (
    Ending,
    Phase,
    SearchOptions,
    Standing,
    losers_of,
    standing,
)
from grounded.search.step_size import Step
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
    """What to run next: the outstanding candidate, a new one, or nothing.

    Args:
        task: the manoeuvre; it judges the trials.
        candidates: those proposed so far, in order.
        trials: stored trials, in order.
        options: the [search] table.
        identity: the name of a new candidate; by default the next after those of this task.
        planner: plans with adopted effects; None: with the task's own model.
        refit: with options.refit, gives the model with parameters fitted to all trials; None: by
            `grounded.fit`.
        tick: told what is going on while planning takes its time.

    Raises:
        GroundedError: where the model's own plan can't be made, with the place in the model.
    """
    planner = planner or Planner(task, task)
    fingerprint = planner.fingerprint
    now = standing(task, candidates, trials, options, fingerprint)
    if now.phase == "await-trial":
        return Proposal(now, now.outstanding, is_new=False)
    if now.phase != "propose":
        return Proposal(now, None, is_new=False)
    if options.refit and now.incumbent is not None:
        planner = planner.with_model((refit or refitted)(planner.plan, trials))
    make = Maker(planner, now, identity or f"c{len(candidates) + 1:04d}", fingerprint)
    if now.incumbent is None:
        policy, plan = planner.first_policy(now.caution, tick)
        if not plan.ok:
            raise GroundedError(
                f"there is no plan to run: {plan.sentence}; mend the model there, or take a start "
                "and a target at which it holds"
            )
        model = planner.plan.problem(exact=True)
        made = make.checked(make.with_margin(make.candidate(policy, model, Step()), model))
        if plan.status == "converged":
            return made
        note = f"the plan is not at the model's optimum: {plan.sentence}"
        return replace(made, notes=(*made.notes, note))
    return _improvement(make, now.incumbent, options)


def refitted(task: Task, trials: Sequence[Trial]) -> Model:
    """The task's model with parameters fitted to all trials that are finite to their end.

    What their instruments show is corrected first. Values that predict held-out time worse
    than the model's own are not taken.
    """
    from grounded.fit import fit
    from grounded.instruments.sound_trials import sound_trials

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
    looked = sound_trials(task, lifted, memory)
    found = fit(task, looked.trials, filters=looked.filters)
    return task.model if found.worse else found.model


def _improvement(make: Maker, incumbent: Tried, options: SearchOptions) -> Proposal:
    """Steps 4 to 6: the first step, from the one that is due on, that the model believes in.

    Another plan goes before it where there is reason for one (`gentler`, `own_plan`). A step
    whose predicted run loses is passed over in the model, at no trial's cost: d must satisfy
    U^(theta + alpha d) >= U^(theta) for some alpha (step 5).
    """
    now = make.now
    if (made := make.gentler(incumbent)) is not None:
        return make.checked(made)
    ways, promised = options.ways(incumbent.candidate), list[float]()
    unsafe: Proposal | None = None
    ruinous: Candidate | None = None
    least = 0.0
    for way in ways[ways.index(now.way) :]:
        step = now.step
        if way != now.way:
            step = options.due(now.history, incumbent, make.fingerprint, way)
        if step is None:
            continue
        about = About(make, incumbent, options, way)
        found = about.step_from(step, promised)
        least = options.tolerance * abs(about.already)
        if way == ways[0] and (own := about.own_plan(found)) is not None:
            found = own
        if found is not None and found.candidate is not None:
            return found
        unsafe, ruinous = unsafe or found, ruinous or about.ruinous
        lost = losers_of(now.history, incumbent.candidate.id, make.fingerprint)
        if promised and not lost and 0 <= max(promised) <= least:
            break  # at the optimum as far as the model can tell: no trial is spent on another way
    return unsafe or Proposal(
        _ended(make, incumbent, promised, least, options.tolerance, ruinous), None, False
    )


def _ended(
    make: Maker,
    incumbent: Tried,
    promised: list[float],
    least: float,
    tolerance: float,
    ruinous: Candidate | None,
) -> Standing:
    """The standing when no step is worth a trial, with the true reason."""
    own, finite = incumbent.candidate.id, [gain for gain in promised if np.isfinite(gain)]
    phase: Phase = "stopped"
    ending: Ending
    then: NextCommand | None = NextCommand("diagnose")
    lost = len(losers_of(make.now.history, own, make.fingerprint))
    if ruinous is not None:
        ending = "too doubtful"
        sentence = (
            f"the model promises {figure(ruinous.predicted_gain)} from a step and is likely to be "
            f"off by more than all that {own} cost: no trial is spent on it; another trial of "
            f"{own}, or a diagnosis, tells more"
        )
    elif promised and not finite:
        ending = "model diverges"
        sentence = (
            f"the model diverges when it is grounded on {own}, whatever the step: it is too far "
            "off there to say how to improve; a diagnosis may say what it lacks"
        )
    elif finite and max(finite) < -least and not lost:
        ending = "every step loses"
        sentence = (
            f"every step from {own} loses in the grounded model, by at least {-max(finite):.4g}: "
            "its slopes don't hold along this trial; a diagnosis may say what it lacks"
        )
    elif lost:
        phase, then, ending = "converged", None, "no step improved"
        sentence = (
            f"{lost} step{'s' * (lost > 1)} from {own} did not improve, and the model promises "
            f"less than {100 * tolerance:g} % from smaller ones: {own} is the result (step 7)"
        )
    else:
        phase, then, ending = "converged", None, "nothing promised"
        sentence = (
            f"the model promises less than {100 * tolerance:g} % more from any step "
            f"([search] tolerance): {own} is the result"
        )
    return replace(make.now, phase=phase, step=None, sentence=sentence, ending=ending, then=then)
