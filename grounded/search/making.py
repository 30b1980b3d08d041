"""Make a candidate: from a step, from gentler gains, or from the plan of a changed model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from grounded.compile.problem import DescentOptions, Problem
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.rollout import Rollout, for_late_samples
from grounded.search.candidate import BY_STEP, Candidate, Slopes, Tried, Way
from grounded.search.corrected import Corrected
from grounded.search.feedback import between_limits, limit_cycle, planned_age
from grounded.search.mispredictions import believed, believed_by_step
from grounded.search.noise import beyond_noise
from grounded.search.planner import Planner, predicted
from grounded.search.safety import objections, spread
from grounded.search.standing import Ending, Proposal, Standing, ended, wild
from grounded.search.step_size import KEPT_PROMISE, SearchOptions, Step, losers_of
from grounded.solve import ddp
from grounded.solve.bias import Grounding, ground
from grounded.solve.measured import measured_gains
from grounded.task import Task
from grounded.trial import Trial, mean_trial

PLANNING = DescentOptions(max_iterations=30, tolerance=1e-6)  # precise enough for a direction
GENTLER = 1e3  # factor on the input weights for each unit of caution
GAIN_SHARE, CAUTION_PARTS = 0.5, 12  # of the mean gain to fall below; parts of a unit of caution
FELL = 10.0  # cost, relative to the run that swung, above which gentler feedback is too weak


def begun_at(task: Task, trials: Sequence[Trial], predicted: Array) -> Trial:
    """Return the mean of a candidate's trials, begun at s_0 where noise alone may differ from it.

    Elsewhere it begins where the samples before the runs tell, if they do (`Trial.began`).
    Otherwise the bias of the first step would take the error of that sample for motion, and apply
    it to every run that begins at s_0: a noisy speed of 0.04 rad/s promised a tenth of the cost.
    """
    mean = mean_trial(trials, task.model.angle_mask)
    off = np.array([task.model.difference(t.began, task.start) for t in trials])
    near = np.logical_not(beyond_noise(trials, off, task.start, predicted))
    first = np.array([task.model.difference(t.states[0], task.start) for t in trials])
    states = np.array(mean.states)
    states[0] += np.where(near, 0.0, off.mean(axis=0)) - first.mean(axis=0)
    return replace(mean, states=states)


class About:
    """The model grounded on the incumbent's trial, and its predictions for other policies.

    If a trial did not start at s_0, its utility can't be compared with predicted runs from s_0. So
    gains are relative to theta's own run in the grounded model (`already`), which equals the trial
    if it started at s_0: a first sample that differs from s_0 by no more than the sensors' noise
    (`begun_at`).
    """

    def __init__(
        self,
        make: Maker,
        incumbent: Tried,
        options: SearchOptions,
        way: Way = "",
    ) -> None:
        self.make, self.incumbent, self.options, self.way = make, incumbent, options, way
        planner, plan = make.planner, make.planner.engaged
        said = incumbent.candidate.predicted_states
        own = planner.lift(begun_at(planner.task, incumbent.trials, said))
        plan.model.system.check(own.states[:-1], own.inputs, plan.model.values, plan.dt)
        self.grounding = ground(plan, own, match_inputs=options.match_inputs)
        exact = ground(plan, own, exact=True, shift=self.grounding.shift)
        real = exact.on(replace(plan.problem(exact=True), age=make.age))
        self.theta = planner.widened(incumbent.candidate.policy)
        self.corrected: Corrected | None = None
        if way == BY_STEP:
            self.corrected = believed_by_step(planner, incumbent, make.now.history, real)
        elif options.damps and len(make.now.history) > 1 and not self._kept():
            self.corrected = believed(planner, incumbent, make.now.history, real)
        self.real = self.corrected.on(real) if self.corrected else real
        already = predicted(self.real, incumbent.candidate.policy).utility
        self.already = already if np.isfinite(already) else incumbent.utility
        self.least = options.tolerance * abs(self.already)
        self.promised: list[float] = []  # gains of steps that were too small

    @property
    def slopes(self) -> Slopes:
        """Which derivatives the model uses."""
        return "corrected" if self.corrected else ""

    def _kept(self) -> bool:
        """Return whether the model's own derivatives predicted the incumbent's gain well."""
        made, history = self.incumbent.candidate, self.make.now.history
        base = next((t for t in history if t.candidate.id == made.base), None)
        if base is None or made.slopes or made.model != self.make.fingerprint:
            return False
        off = self.incumbent.gain_over(base) - made.predicted_gain
        lost = losers_of(history, made.id, made.model)
        return not lost and abs(off) <= (1 - KEPT_PROMISE) * made.predicted_gain

    def candidate(self, policy: Policy, step: Step, way: Way) -> Candidate:
        """Return a candidate with this model's prediction."""
        made = self.make.candidate(policy, self.real, step, self.already, way)
        return replace(made, slopes=self.slopes)

    def step_from(self, first: Step) -> Proposal | None:
        """Return the first step worth a trial, else one that is not allowed, else None.

        `first` is the due step, regardless of the derivatives of those that lost.
        """
        make, options = self.make, self.options
        known = (make.now.history, self.incumbent, make.fingerprint)
        first = options.due(*known, self.way, self.slopes) or first
        unsafe: Proposal | None = None
        directions: dict[float, Policy] = {}
        for step in options.steps_from(first):
            if step.damping not in directions:
                found = direction(
                    make.planner.engaged,
                    self.theta,
                    self.grounding,
                    options,
                    step.damping,
                    self.corrected,
                    make.planner.task.model.n,
                )
                directions[step.damping] = for_late_samples(found, self.real)
            policy = self.theta.toward(directions[step.damping], step.alpha)
            made = self.candidate(policy, step, self.way)
            if made.predicted_gain > self.least:
                proposal = make.checked(made)
                if proposal.candidate is not None:
                    return proposal
                unsafe = proposal
                continue
            self.promised.append(made.predicted_gain)
            if abs(made.predicted_gain) <= self.least:
                break
        return unsafe

    def own_plan(self, rival: Proposal | None) -> Proposal | None:
        """Return the changed model's own plan if its predicted gain exceeds the rival's.

        The plan of the crude model may lie near another local optimum than that of the better
        model, where local steps from it can't go. Both are judged by the grounded prediction. No
        gain is required if the incumbent's trial failed badly or was a limit cycle, since a bias
        measured there does not apply to other runs.
        """
        make, base = self.make, self.incumbent.candidate
        tried = losers_of(make.now.history, base.id, make.fingerprint, "own plan")
        if base.model == make.fingerprint or tried:
            return None
        policy, _ = make.planner.first_policy()
        made = self.candidate(for_late_samples(policy, self.real), Step(), "own plan")
        promise = rival.candidate.predicted_gain if rival and rival.candidate else self.least
        swung = wild(self.incumbent) or limit_cycle(self.incumbent, make.planner.task)
        if not (swung or made.predicted_gain > max(promise, self.least)):
            return None
        proposal = make.checked(made)
        return proposal if proposal.candidate is not None else None


@dataclass(frozen=True, eq=False)
class Maker:
    """Makes candidates: the policy as a robot can run it, and its predicted run."""

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
        caution: float | None = None,
    ) -> Candidate:
        """Return a candidate; its gains are as gentle as the incumbent's, or set by `caution`."""
        base, policy = self.now.incumbent, self.planner.narrowed(policy)
        if caution is None:
            follows = base is not None and base.candidate.base and way != "own plan"
            caution = base.candidate.caution if base and follows else self.now.caution
            caution = max(caution, self.gentled)
        if caution and base is not None:
            policy = self._gently(policy, problem, predicted(problem, policy), caution)
        run, task = predicted(problem, policy), self.planner.task
        return Candidate(
            id=self.identity,
            policy=policy,
            iteration=0 if base is None else self.now.iteration + 1,
            alpha=step.alpha,
            damping=step.damping,
            base="" if base is None else base.candidate.id,
            model=self.fingerprint,
            predicted_states=run.states[:, : task.model.n],
            predicted_inputs=run.inputs,
            predicted_utility=run.utility,
            predicted_gain=run.utility - already,
            sample_age=problem.age,
            caution=caution,
            way=way,
            seen=tuple(one.id for tried in self.now.history for one in tried.trials if one.id),
            units={**task.model.states, **task.model.inputs},
        )

    def gentler(self, incumbent: Tried) -> Candidate | None:
        """Return the incumbent's plan with gentler gains if its loop was unstable on the robot.

        High gains together with a delay that the model lacks cause a limit cycle. Steps along a
        direction do not remove it: the grounded model replays it but contains no delay. An input
        that swings from limit to limit needs much lower gains. Otherwise the cause may be noise
        amplified by high gains, and the gains are only about halved.
        """
        own = incumbent.candidate
        lost = losers_of(self.now.history, own.id, self.fingerprint, "gentler gains")
        if lost or own.policy.gain is None or own.model != self.fingerprint:
            return None
        if not limit_cycle(incumbent, self.planner.task):
            return None
        problem, caution = self.planner.plan.problem(exact=True), own.caution + 1.0
        if not between_limits(incumbent, self.planner.task):
            run, most = predicted(problem, own.policy), GAIN_SHARE * own.policy.mean_gain
            less = own.caution + np.arange(1, CAUTION_PARTS) / CAUTION_PARTS
            each = ((self._gently(own.policy, problem, run, one).mean_gain, one) for one in less)
            caution = float(next((one for gain, one in each if gain < most), caution))
        real = incumbent.utility
        return self.candidate(own.policy, problem, Step(), real, "gentler gains", caution)

    @cached_property
    def gentled(self) -> float:
        """The caution of gains that were made gentler in this model; 0 if none were.

        Gains once made gentler stay so. If such a run failed, or cost many times as much as the one
        that swung, the robot needs its gains.
        """
        cost = {tried.candidate.id: -tried.utility for tried in self.now.history}
        kept = [
            tried.candidate.caution
            for tried in self.now.history
            if tried.candidate.way == "gentler gains" and tried.candidate.model == self.fingerprint
            if -tried.utility <= FELL * cost[tried.candidate.base]
        ]
        return max(kept, default=0.0)

    def _gently(self, policy: Policy, problem: Problem, run: Rollout, caution: float) -> Policy:
        """Return the same run with the gains of an LQR with GENTLER ** caution the input weight."""
        if policy.gain is None:
            return policy
        gentle = self.planner.dearer(problem, GENTLER**caution)
        found = ddp.sweep(gentle, run.z, run.inputs)
        if not (found.ok and np.isfinite(run.z).all()):
            return policy
        plan, columns = self.planner.plan, base_columns(problem, self.planner.plan)
        n = self.planner.task.model.n
        K = measured_gains(gentle, run.z, run.inputs, found.gains.K, n)
        made = plan.policy(run.inputs, K[:, :, columns], run.z[:-1, columns])
        return self.planner.narrowed(for_late_samples(made, problem))

    @cached_property
    def age(self) -> float:
        """The age of the samples to plan for [s]."""
        return planned_age(self.planner.task, self.now.history)

    def checked(self, made: Candidate) -> Proposal:
        """Return a proposal of the candidate, or a refusal if it violates limits or [safety]."""
        task, history = self.planner.task, self.now.history
        if not (against := objections(task, made, spread(task, history, self.fingerprint))):
            return Proposal(self.now, made, is_new=True)
        ending = Ending.GAINS if against[0].code == "plan.gain" else Ending.NOT_ALLOWED
        stopped = ended(self.now, ending, against[0])
        return Proposal(stopped, None, is_new=False, findings=against)


# --- the direction of a step (step 5) ---


def direction(
    task: Task,
    policy: Policy,
    grounding: Grounding,
    options: SearchOptions,
    damping: float = 1.0,
    corrected: Corrected | None = None,
    measured: int | None = None,
) -> Policy:
    """Step 5: return theta' such that d = theta' - theta improves the policy in the biased model.

    Args:
        task: the manoeuvre, with the ORIGINAL model.
        policy: theta, the policy that ran the trial.
        grounding: the trial as the biased model replays it (step 4).
        options: selects algorithm A.
        damping: lambda of `step_size`, factor on the penalty mu for leaving the trial's inputs.
        corrected: the model with derivatives corrected by trials; None for the original model.
        measured: number of leading states that the robot measures; None for all of the task's.
            Gains on the memory of an adopted effect are replaced by gains on those
            (`measured_gains`). Gains on the memory of a corrected model are dropped.
    """
    if options.method == "policy-gradient":
        from grounded.solve.policy_gradient import ascent

        return ascent(task, policy, grounding)
    problem = grounding.on(task.problem())
    if options.step == "damped":
        problem = damped(problem, grounding.inputs, damping)
    z = grounding.z
    if corrected is not None:
        problem, z = corrected.on(problem), corrected.along(z)
    gains = ddp.sweep(problem, z, grounding.inputs).gains
    found = ddp.solve(problem, grounding.inputs, gains.K, z[:-1], PLANNING)
    K = found.K
    if measured is not None and measured < task.model.n:
        K = measured_gains(problem, found.z, found.u, K, measured)
    columns = base_columns(problem, task)
    return task.policy(found.u, K[:, :, columns], found.z[:-1, columns])


def base_columns(problem: Problem, task: Task) -> list[int]:
    """Return the columns of the problem's z that the task's z has as well."""
    own = map(problem.system.states.index, task.model.state_names)
    return [*own, *range(problem.system.n, problem.nz)]


def damped(problem: Problem, inputs: Array, factor: float = 1.0) -> Problem:
    """Add a penalty mu |u_t - inputs_t|^2 on leaving the trial's inputs (H, m) to the problem.

    A fully converged step goes to the optimum of the biased MODEL, which need not improve the real
    system. The penalty turns the step towards the gradient, which does as long as it is within 90
    degrees of the true one (section 3). mu is `factor` times R + S, the problem's own weights on
    inputs and their changes, as in norm-optimal iterative learning control. The two quadratic
    penalties on u_t combine to the weight R + mu about (R u_target + mu inputs) / (R + mu).
    """
    mu = factor * (problem.input_weight + problem.change_weight)
    weight = problem.input_weight + mu
    mixed = problem.input_weight * problem.input_target + mu * inputs
    safe = np.where(weight > 0, weight, 1.0)
    return replace(problem, input_weight=weight, input_target=mixed / safe)
