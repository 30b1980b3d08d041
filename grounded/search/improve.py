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
from grounded.search.secants import slope_error, with_slope
from grounded.search.standing import (
    Candidate,
    Ending,
    Phase,
    SearchOptions,
    Standing,
    Tried,
    Way,
    losers_of,
    standing,
    wild,
)
from grounded.search.step_size import Step
from grounded.solve import ddp
from grounded.solve.bias import Grounding, ground
from grounded.task import Task
from grounded.trial import Trial, mean_trial

GENTLER = 1e3  # factor on the price of inputs from which gentler gains are designed
GENTLER_TIMES = 2  # they are tried
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
    task: Task,
    policy: Policy,
    grounding: Grounding,
    options: SearchOptions,
    damping: float = 1.0,
    slope: Array | None = None,
) -> Policy:
    """Step 5: theta' such that d = theta' - theta improves the policy in the biased model.

    Args:
        task: the manoeuvre, with the ORIGINAL model.
        policy: theta, the policy that ran the trial.
        grounding: the trial as the biased model replays it (step 4).
        options: which algorithm A.
        damping: lambda of `step_size`, the share of mu that leaving the trial's inputs costs.
        slope: what the utility's slope by the inputs is more than the model's, see `secants`.
    """
    if options.method == "policy-gradient":
        from grounded.solve.policy_gradient import ascent

        return ascent(task, policy, grounding)
    problem = grounding.on(task.problem())
    if options.step == "damped":
        problem = damped(problem, grounding.inputs, damping)
    if slope is not None:
        problem = with_slope(problem, slope)
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

    Another plan goes before it where there is reason for one (`gentler`, `own_plan`). A step
    whose predicted run loses is passed over in the model, at no trial's cost: d must satisfy
    U^(theta + alpha d) >= U^(theta) for some alpha (step 5).
    """
    now = make.now
    if (made := make.gentler(incumbent)) is not None:
        return make.checked(made)
    ways, promised = options.ways(incumbent.candidate), list[float]()
    unsafe: Proposal | None = None
    least = 0.0
    for way in ways[ways.index(now.way) :]:
        step = now.step
        if way != now.way:
            step = options.due(now.history, incumbent, make.fingerprint, way)
        if step is None:
            continue
        about = _About(make, incumbent, options, way)
        found = about.step_from(step, promised)
        least = options.tolerance * abs(about.already)
        if way == ways[0] and (own := about.own_plan(found)) is not None:
            found = own
        if found is not None and found.candidate is not None:
            return found
        unsafe = unsafe or found
    return unsafe or Proposal(
        _ended(make, incumbent, promised, least, options.tolerance), None, False
    )


class _About:
    """The model grounded on the incumbent's trial, and what it promises of other policies.

    Where a trial started off s_0, its utility is no measure for runs that start there: theta's own
    run in the grounded model is (`already`). It replays the trial when the start was s_0.
    """

    def __init__(self, make: _Maker, incumbent: Tried, options: SearchOptions, way: Way) -> None:
        self.make, self.incumbent, self.options, self.way = make, incumbent, options, way
        planner, plan = make.planner, make.planner.plan
        own = planner.lift(mean_trial(incumbent.trials, planner.task.model.angle_mask))
        plan.model.system.check(own.states[:-1], own.inputs, plan.model.values, plan.dt)
        matched = options.match_inputs and way != "recorded inputs"
        self.grounding = ground(plan, own, match_inputs=matched)
        exact = ground(plan, own, exact=True, shift=self.grounding.shift)
        self.real = exact.on(plan.problem(exact=True))
        self.theta = planner.widened(incumbent.candidate.policy)
        already = simulate(self.real, self.theta).utility
        self.already = already if np.isfinite(already) else incumbent.utility
        self.least = options.tolerance * abs(self.already)
        self.slope: Array | None = None
        if options.damps and np.isfinite(already):
            self.slope = slope_error(planner, incumbent, make.now.history, self.real)

    def candidate(self, policy: Policy, step: Step, way: Way) -> Candidate:
        """A candidate with what is promised of it, mispredictions of earlier trials included."""
        made = self.make.candidate(policy, self.real, step, self.already, way)
        if self.slope is None:
            return made
        moved = made.predicted_inputs - self.grounding.inputs[: len(self.slope)]
        more = float(np.sum(self.slope * moved))
        return replace(
            made,
            predicted_gain=made.predicted_gain + more,
            predicted_utility=made.predicted_utility + more,
        )

    def step_from(self, first: Step, promised: list[float]) -> Proposal | None:
        """The first step worth a trial; one that is not allowed, or None; adds to the promises."""
        make, options, plan = self.make, self.options, self.make.planner.plan
        own = self.incumbent.candidate.id
        lost = losers_of(make.now.history, own, make.fingerprint, self.way)
        losers = {(candidate.damping, candidate.alpha) for candidate in lost}
        unsafe: Proposal | None = None
        directions: dict[float, Policy] = {}
        for step in options.steps_from(first):
            if (step.damping, step.alpha) in losers:
                continue
            if step.damping not in directions:
                directions[step.damping] = direction(
                    plan, self.theta, self.grounding, options, step.damping, self.slope
                )
            policy = self.theta.toward(directions[step.damping], step.alpha)
            made = self.candidate(policy, step, self.way)
            if made.predicted_gain > self.least:
                proposal = make.checked(made)
                if proposal.candidate is not None:
                    return proposal
                unsafe = proposal
                continue
            promised.append(made.predicted_gain)
            if abs(made.predicted_gain) <= self.least:
                break
        return unsafe

    def own_plan(self, rival: Proposal | None) -> Proposal | None:
        """A model that was changed since: its own new plan, where more is promised of that.

        The plan of a crude model may sit in another valley than that of the better one: going on
        from it ends where it began. Both are judged by the grounded prediction.
        """
        make, base = self.make, self.incumbent.candidate
        tried = losers_of(make.now.history, base.id, make.fingerprint, "own plan")
        if base.model == make.fingerprint or tried:
            return None
        policy, _ = first_policy(make.planner.plan)
        made = self.candidate(policy, Step(), "own plan")
        promise = rival.candidate.predicted_gain if rival and rival.candidate else self.least
        proposal = make.checked(made) if made.predicted_gain > promise else None
        return proposal if proposal is not None and proposal.candidate is not None else None


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
        self,
        policy: Policy,
        problem: Problem,
        step: Step,
        already: float = float("nan"),
        way: Way = "",
        caution: int | None = None,
    ) -> Candidate:
        """A candidate; its gains are designed as gently as its incumbent's, or by `caution`."""
        base, policy = self.now.incumbent, self.planner.narrowed(policy)
        if caution is None:
            follows = base is not None and base.candidate.base and way != "own plan"
            caution = base.candidate.caution if base and follows else self.now.caution
        if caution and base is not None:
            policy = self._gently(policy, problem, caution)
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
            caution=caution,
            way=way,
        )

    def gentler(self, incumbent: Tried) -> Candidate | None:
        """The model's own plan with gentler gains, where its loop was unstable on the robot.

        High gains and a delay that the model lacks make a limit cycle, which no step along a
        direction leaves: the grounded model replays it, and has no delay to blame.
        """
        own = incumbent.candidate
        lost = losers_of(self.now.history, own.id, self.fingerprint, "gentler gains")
        if not wild(incumbent) or own.policy.gain is None or len(lost) >= GENTLER_TIMES:
            return None
        if own.model != self.fingerprint:
            return None
        problem, real = self.planner.plan.problem(exact=True), incumbent.utility
        caution = own.caution + len(lost) + 1
        return self.candidate(own.policy, problem, Step(), real, "gentler gains", caution)

    def _gently(self, policy: Policy, problem: Problem, caution: int) -> Policy:
        """The same run with the gains of a regulator whose inputs cost GENTLER ** caution more."""
        if policy.gain is None:
            return policy
        run = simulate(problem, self.planner.widened(policy))
        factor = GENTLER**caution
        weight = factor * problem.input_weight + (factor - 1) * problem.change_weight
        found = ddp.sweep(replace(problem, input_weight=weight), run.z, run.inputs)
        if not (found.ok and np.isfinite(run.z).all()):
            return policy
        plan = self.planner.plan
        return self.planner.narrowed(plan.policy(run.inputs, found.gains.K, run.z[:-1]))

    def checked(self, made: Candidate) -> Proposal:
        """A candidate that is finite, inside the limits and predicted to stay safe; or none."""
        task = self.planner.task
        found = objections(task, made, spread(task, self.now.history))
        if not found:
            return Proposal(self.now, made, is_new=True)
        stopped = replace(self.now, phase="stopped", sentence=found[0], ending="not allowed")
        return Proposal(stopped, None, is_new=False, notes=tuple(found))
