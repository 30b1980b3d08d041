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
| 5    | direction d from algorithm A in that model     | `direction` (`ddp`, `policy_gradient`)  |
| 6    | theta + alpha d, line search on the real system| `Policy.toward`, `step_size`            |
| 7    | none improves: return the current policy       | `standing`                              |

`propose` is a pure function: the same candidates and trials give the same next candidate, bit for
bit. `ask_tell` is the loop around it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.compile import DescentOptions, Problem
from grounded.errors import NextCommand
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.result import Result, document
from grounded.rollout import simulate
from grounded.search.first_policy import Tick, first_policy
from grounded.search.planner import Planner
from grounded.search.safety import objections, spread
from grounded.search.standing import (
    Candidate,
    Ending,
    Phase,
    SearchOptions,
    Standing,
    Tried,
    losers_of,
    standing,
)
from grounded.search.step_size import Step
from grounded.solve import ddp
from grounded.solve.bias import Grounding, ground
from grounded.task import Task
from grounded.trial import Trial, mean_trial

PLANNING = DescentOptions(max_iterations=30, tolerance=1e-6)  # a direction needs no more digits


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Result):
    """What to run next, or why nothing is: `candidate` is None when the search has ended."""

    standing: Standing
    candidate: Candidate | None
    is_new: bool
    notes: tuple[str, ...] = ()

    def summary(self) -> str:
        """The candidate, or the end of the search."""
        return self.candidate.summary() if self.candidate else self.standing.summary()

    def to_json(self) -> dict[str, Any]:
        """The document of `grounded propose --json`; `file` is for whoever writes the candidate."""
        now, made = self.standing, self.candidate
        known = document(
            candidate=made and made.id,
            file=None,
            iteration=made.iteration if made else now.iteration,
            alpha=made and made.alpha,
            damping=made.damping if made and made.base else None,
            predicted_utility=made and made.predicted_utility,
            phase="await-trial" if made else now.phase,
            sentence=now.sentence,
            notes=self.notes,
        )
        best = now.incumbent and now.incumbent.utility
        return known | document(best_utility=best, new=self.is_new) if made else known


def model_fingerprint(task: Task) -> str:
    """16 hex digits over the model that plans: its values, latency, smoothing and predictions.

    Predictions at fixed points stand for the code of the dynamics, which has no other identity.
    """
    model, problem = task.model, task.problem(exact=True)
    digest = hashlib.sha256()
    digest.update(repr((model.state_names, model.input_names, model.param_names)).encode())
    rng = np.random.default_rng(0)
    x = task.start + rng.uniform(-0.5, 0.5, (8, model.n))
    u = np.clip(task.past + rng.uniform(-0.5, 0.5, (8, model.m)), task.low, task.high)
    with np.errstate(all="ignore"):
        moved = problem.system.step(x, u, problem.p, problem.dt)
    for array in (model.values, problem.delay, np.array([task.smoothing]), np.round(moved, 9)):
        digest.update(np.ascontiguousarray(array + 0.0).tobytes())
    return digest.hexdigest()[:16]


def direction(
    task: Task, policy: Policy, grounding: Grounding, options: SearchOptions, damping: float = 1.0
) -> Policy:
    """Step 5: theta' such that d = theta' - theta improves the policy in the biased model.

    Args:
        task: the manoeuvre, with the ORIGINAL model.
        policy: theta, the policy that ran the trial.
        grounding: the trial as the biased model replays it (step 4).
        options: which algorithm A.
        damping: lambda of `step_size`, the share of mu that leaving the trial's inputs costs.
    """
    if options.method == "policy-gradient":
        from grounded.solve.policy_gradient import ascent

        return ascent(task, policy, grounding)
    problem = grounding.on(task.problem())
    if options.step == "damped":
        problem = damped(problem, grounding.inputs, damping)
    gains = ddp.sweep(problem, grounding.z, grounding.inputs).gains
    result = ddp.solve(problem, grounding.inputs, gains.K, grounding.z[:-1], PLANNING)
    return task.policy(result.u, result.K, result.z[:-1])


def damped(problem: Problem, inputs: Array, factor: float = 1.0) -> Problem:
    """The problem with a price mu |u_t - inputs_t|^2 on leaving the trial's inputs (H, m).

    The fully converged step goes to the optimum of the biased MODEL, and that need not be uphill in
    the real system; with mu it turns towards the gradient, which is uphill while the
    model's derivatives are within 90 degrees (section 3). mu = R + S, the problem's own weights on
    inputs: the same idea as norm-optimal iterative learning control. Both quadratic penalties on
    u_t are one: weight R + mu about (R u_target + mu inputs) / (R + mu).
    """
    mu = factor * (problem.input_weight + problem.change_weight)
    weight = problem.input_weight + mu
    mixed = problem.input_weight * problem.input_target + mu * inputs
    safe = np.where(weight > 0, weight, 1.0)
    return replace(problem, input_weight=weight, input_target=mixed / safe)


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
    """
    planner = planner or Planner(task, task)
    fingerprint = model_fingerprint(planner.plan)
    now = standing(task, candidates, trials, options, fingerprint)
    if now.phase == "await-trial":
        return Proposal(now, now.outstanding, is_new=False)
    if now.phase != "propose":
        return Proposal(now, None, is_new=False)
    if options.refit and now.incumbent is not None:
        planner = planner.with_model((refit or refitted)(planner.plan, trials))
    make = _Maker(planner, now, identity or f"c{len(candidates) + 1:04d}", fingerprint)
    if now.incumbent is None:
        policy, plan = first_policy(planner.plan, now.caution, tick)
        made = make.checked(make.candidate(policy, planner.plan.problem(exact=True), Step()))
        if plan.status == "converged":
            return made
        note = f"the plan is not at the model's optimum: {plan.sentence}"
        return replace(made, notes=(*made.notes, note))
    return _improvement(make, now.incumbent, options)


def refitted(task: Task, trials: Sequence[Trial]) -> Model:
    """The task's model with parameters fitted to all trials that are finite to their end."""
    from grounded.fit import fit

    return fit(task, [t for t in trials if t.finite_steps == t.steps and t.steps > 2]).model


def _improvement(make: _Maker, incumbent: Tried, options: SearchOptions) -> Proposal:
    """Steps 4 to 6: the first step, from the one that is due on, that the model believes in.

    A step whose predicted run loses is passed over in the model, at no trial's cost: d must satisfy
    U^(theta + alpha d) >= U^(theta) for some alpha (step 5).
    """
    planner, plan = make.planner, make.planner.plan
    own = planner.lift(mean_trial(incumbent.trials, planner.task.model.angle_mask))
    plan.model.system.check(own.states[:-1], own.inputs, plan.model.values, plan.dt)
    matched = options.match_inputs
    grounding = ground(plan, own, match_inputs=matched)
    exact = ground(plan, own, exact=True, shift=grounding.shift)
    real = exact.on(plan.problem(exact=True))
    theta = planner.widened(incumbent.candidate.policy)
    # Where a trial started off s_0, its utility is no measure for runs that start there: theta's
    # own run in the grounded model is. It replays the trial when the start was s_0.
    already = simulate(real, theta).utility
    already = already if np.isfinite(already) else incumbent.utility
    least = options.tolerance * abs(already)
    lost = losers_of(make.now.history, incumbent.candidate.id, make.fingerprint)
    losers = {(candidate.damping, candidate.alpha) for candidate in lost}
    unsafe: Proposal | None = None
    promised: list[float] = []
    directions: dict[float, Policy] = {}
    for step in options.steps_from(make.now.step):
        if (step.damping, step.alpha) in losers:
            continue
        if step.damping not in directions:
            directions[step.damping] = direction(plan, theta, grounding, options, step.damping)
        policy = theta.toward(directions[step.damping], step.alpha)
        made = make.candidate(policy, real, step, already)
        if made.predicted_gain > least:
            proposal = make.checked(made)
            if proposal.candidate is not None:
                return proposal
            unsafe = proposal
            continue
        promised.append(made.predicted_gain)
        if abs(made.predicted_gain) <= least:
            break
    if unsafe is not None:
        return unsafe
    return Proposal(_ended(make, incumbent, promised, least, options.tolerance), None, False)


def _ended(
    make: _Maker, incumbent: Tried, promised: list[float], least: float, tolerance: float
) -> Standing:
    """The standing when no step is worth a trial, with the true reason."""
    own, finite = incumbent.candidate.id, [gain for gain in promised if np.isfinite(gain)]
    phase: Phase = "stopped"
    ending: Ending
    then: NextCommand | None = NextCommand("diagnose")
    lost = len(losers_of(make.now.history, own, make.fingerprint))
    if promised and not finite:
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


@dataclass(frozen=True, eq=False)
class _Maker:
    """Makes candidates of a policy: what a robot can run of it, and its predicted run."""

    planner: Planner
    now: Standing
    identity: str
    fingerprint: str

    def candidate(
        self, policy: Policy, problem: Problem, step: Step, already: float = float("nan")
    ) -> Candidate:
        base, policy = self.now.incumbent, self.planner.narrowed(policy)
        predicted = simulate(problem, self.planner.widened(policy))
        return Candidate(
            id=self.identity,
            policy=policy,
            iteration=0 if base is None else self.now.iteration + 1,
            alpha=step.alpha,
            damping=step.damping,
            predicted_gain=predicted.utility - already,
            base="" if base is None else base.candidate.id,
            model=self.fingerprint,
            predicted_states=predicted.states[:, : self.planner.task.model.n],
            predicted_inputs=predicted.inputs,
            predicted_utility=predicted.utility,
            caution=self.now.caution,
        )

    def checked(self, made: Candidate) -> Proposal:
        """A candidate that is finite, inside the limits and predicted to stay safe; or none."""
        task = self.planner.task
        found = objections(task, made, spread(task, self.now.history))
        if not found:
            return Proposal(self.now, made, is_new=True)
        stopped = replace(self.now, phase="stopped", sentence=found[0], ending="not allowed")
        return Proposal(stopped, None, is_new=False, notes=tuple(found))
