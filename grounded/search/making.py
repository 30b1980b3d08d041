"""Making a candidate: of a step, of gentler gains, or of the plan of a model that was changed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded.compile import Problem
from grounded.policy import Policy
from grounded.result import Result, document
from grounded.rollout import Rollout, apart
from grounded.search.candidate import LITTLE, Candidate, Slopes, Tried, Way
from grounded.search.directions import base_columns, direction
from grounded.search.limit_cycle import between_limits, limit_cycle
from grounded.search.margin import steadied
from grounded.search.planner import Planner, predicted
from grounded.search.safety import objections, spread
from grounded.search.standing import SearchOptions, Standing, losers_of, wild
from grounded.search.step_size import KEPT, Step
from grounded.solve import ddp
from grounded.solve.measured import measured_gains
from grounded.trial import mean_trial

if TYPE_CHECKING:
    from grounded.search.corrected import Corrected
    from grounded.search.feedback import Alternative

GENTLER = 1e3  # factor on the price of inputs from which gentler gains are designed
HALF, FINE = 0.5, 12  # of the mean gain is left where no limit is met; parts of a caution
NEAR = 0.2  # of the way that one that lost would go: a step that ends so near is the same one
REFUTED = 2  # steps by corrected slopes that lost too much: then the model's own are believed
FORETOLD = 0.2  # of the incumbent's cost: a plain model that is off by more there is no judge


class About:
    """The model grounded on the incumbent's trial, and what it promises of other policies.

    Where a trial started off s_0, its utility is no measure for runs that start there: theta's own
    run in the grounded model is (`already`). It replays the trial when the start was s_0.
    """

    def __init__(self, make: Maker, incumbent: Tried, options: SearchOptions, way: Way) -> None:
        self.make, self.incumbent, self.options, self.way = make, incumbent, options, way
        planner, plan = make.planner, make.planner.plan
        own = planner.lift(mean_trial(incumbent.trials, planner.task.model.angle_mask))
        plan.model.system.check(own.states[:-1], own.inputs, plan.model.values, plan.dt)
        matched = options.match_inputs and way != "recorded inputs"
        from grounded.solve.bias import ground

        self.grounding = ground(plan, own, match_inputs=matched)
        exact = ground(plan, own, exact=True, shift=self.grounding.shift)
        self.real = exact.on(plan.problem(exact=True))
        self.theta = planner.widened(incumbent.candidate.policy)
        self.run = (own.states[:, : planner.task.model.n], own.inputs)
        self.corrected: Corrected | None = None
        self.missed = 0.0  # share of its movements that the model is likely to be off by
        self.alternatives: tuple[Alternative, ...] = ()
        if options.damps and len(make.now.history) > 1 and not self._kept():
            from grounded.search.mispredictions import believed

            trusted = self._refuted() < REFUTED
            found = believed(planner, incumbent, make.now.history, self.real, trusted)
            self.alternatives = found.alternatives
            self.real, self.corrected, self.missed = found.problem, found.corrected, found.missed
        already = predicted(self.real, incumbent.candidate.policy).utility
        self.already = already if np.isfinite(already) else incumbent.utility
        began = np.append(own.states[0], self.real.start[own.states.shape[1] :])
        as_run = replace(self.real, start=began)  # theta's from where its trial began
        self.as_run = predicted(as_run, incumbent.candidate.policy).utility
        self.least = options.tolerance * abs(self.already)
        self.plain = plan.problem(exact=True)  # no trial in it, hence no noise and no start
        self.plainly = predicted(self.plain, incumbent.candidate.policy).utility
        self.ruinous: Candidate | None = None  # a step that was foretold to lose, and not taken

    @property
    def slopes(self) -> Slopes:
        """Whose they are."""
        return "corrected" if self.corrected else ""

    def _kept(self) -> bool:
        """Whether the model's own slopes have foretold what the step to the incumbent brought."""
        made, history = self.incumbent.candidate, self.make.now.history
        base = next((t for t in history if t.candidate.id == made.base), None)
        if base is None or made.slopes or made.model != self.make.fingerprint:
            return False
        off = self.incumbent.utility - base.utility - made.predicted_gain
        lost = losers_of(history, made.id, made.model)
        return not lost and abs(off) <= (1 - KEPT) * made.predicted_gain

    def _refuted(self) -> int:
        """How many steps by corrected slopes lost by more than they were likely to be off by."""
        best, model = self.incumbent, self.make.fingerprint
        lost = losers_of(self.make.now.history, best.candidate.id, model)
        corrected = {candidate.id for candidate in lost if candidate.slopes}
        return sum(
            tried.utility - best.utility < tried.candidate.expected_gain
            for tried in self.make.now.history
            if tried.candidate.id in corrected
        )

    def candidate(self, policy: Policy, step: Step, way: Way) -> Candidate:
        """A candidate with what this model promises of it, and how far that is likely to be off."""
        made = self.make.candidate(policy, self.real, step, self.already, way)
        made = replace(made, slopes=self.slopes, base_as_run=self.as_run)
        return self._steadied(made) if made.predicted_gain > self.least else made

    def _steadied(self, made: Candidate) -> Candidate:
        """The same run with the incumbent's gains, where the new ones may not hold (`feedback`).

        A changed model's own plan keeps its own: the incumbent's were designed in a model that
        lacked what was found since, a delay say, and that is what made them swing.
        """
        new, run = made.policy, self.incumbent.candidate.policy
        own = made.way == "own plan" or new.gain is None or run.gain is None
        if self.alternatives and not own:
            old = replace(new, gain=run.laid_out(new.state_names, new.angles, new.depths).gain)
            if sum(a.cost(new) - a.cost(old) for a in self.alternatives) > self.least:
                made = self.make.foretold(made, old, self.real, self.already)
        if not self.missed:
            return made
        moved = apart(self.real, (made.predicted_states, made.predicted_inputs), self.run)
        return replace(made, likely_off=self.missed * moved)

    def step_from(self, first: Step, promised: list[float]) -> Proposal | None:
        """The first step worth a trial; one that is not allowed, or None; adds to the promises.

        One that is likely to lose, for what the model misses, is left for when there is no other.
        One that any of the models that explain the trials foretells to be a disaster is none.
        One whose run is nearly that of a candidate that lost is none: where the price on leaving
        the trial's inputs is small beside the others, ten times the damping is the same step.

        Args:
            first: the step that is due, whatever the slopes of those that lost.
            promised: gains that were too small.
        """
        make, options = self.make, self.options
        history, model = make.now.history, make.fingerprint
        first = options.due(history, self.incumbent, model, self.way, self.slopes) or first
        lost = losers_of(history, self.incumbent.candidate.id, model)
        foretold = [predicted(self.real, candidate.policy) for candidate in lost]
        unsafe: Proposal | None = None
        doubted: Proposal | None = None
        directions: dict[float, Policy] = {}
        for step in options.steps_from(first):
            if step.damping not in directions:
                directions[step.damping] = direction(
                    make.planner.aim,
                    self.theta,
                    self.grounding,
                    options,
                    step.damping,
                    self.corrected,
                    make.planner.task.model.n,
                )
            policy = self.theta.toward(directions[step.damping], step.alpha)
            made = self.candidate(policy, step, self.way)
            if any(self._near(made, run) for run in foretold):
                continue
            if made.predicted_gain > self.least:
                proposal = make.checked(make.with_margin(made, self.real))
                if proposal.candidate is None:
                    unsafe = proposal
                    continue
                told = self._told(proposal.candidate)
                proposal = replace(proposal, candidate=told)
                if self._ruinous(told):
                    self.ruinous = self.ruinous or told
                elif made.expected_gain > self.least:
                    return proposal
                else:
                    doubted = doubted or proposal
                continue
            promised.append(made.predicted_gain)
            if abs(made.predicted_gain) <= self.least:
                break
        return doubted or unsafe

    def _ruinous(self, made: Candidate) -> bool:
        """Whether it is foretold to lose more than all that the incumbent costs there."""
        return made.expected_gain < -max(self._disturbed, -self.incumbent.utility)

    @cached_property
    def _disturbed(self) -> float:
        """What the incumbent's policy costs in the alternatives."""
        return sum(a.cost(self.incumbent.candidate.policy) for a in self.alternatives)

    def _near(self, made: Candidate, lost: Rollout) -> bool:
        """Whether a candidate is to do nearly what one that lost would do in this model."""
        run, other = (made.predicted_states, made.predicted_inputs), (lost.states, lost.inputs)
        return apart(self.real, run, other) <= NEAR**2 * apart(self.real, self.run, other)

    def _told(self, made: Candidate) -> Candidate:
        """The same; it is likely to be off by no less than what other models say.

        Those are the alternatives and the plain model, where that foretold the incumbent's trial.
        """
        gains = [made.predicted_gain - made.likely_off]
        if self.alternatives:
            cost = sum(a.cost(made.policy) for a in self.alternatives)
            gains.append(self._disturbed - cost)
        if (plainly := self._plain_gain(made)) is not None and plainly + self._plain_off < 0:
            gains.append(plainly + self._plain_off)
        return replace(made, likely_off=made.predicted_gain - min(gains))

    @property
    def _plain_off(self) -> float:
        """What the model with no trial in it is off by at the incumbent."""
        return abs(self.plainly - self.incumbent.utility)

    def _plain_gain(self, made: Candidate) -> float | None:
        """What that model promises over the incumbent; None where it did not foretell that."""
        if not self._plain_off < FORETOLD * -self.incumbent.utility:
            return None
        return predicted(self.plain, made.policy).utility - self.plainly

    def own_plan(self, rival: Proposal | None) -> Proposal | None:
        """A model that was changed since: its own new plan, where more is promised of that.

        The plan of a crude model may sit in another valley than that of the better one: going on
        from it ends where it began. Both are judged by the grounded prediction, less what it is
        likely to be off by so far away; and the own plan by the changed model alone as well, where
        that foretells the incumbent's trial (`_worth`). It needs no promise where that trial was
        wild, or its feedback swung to and fro: a bias measured there says nothing of other runs.
        """
        make, base = self.make, self.incumbent.candidate
        tried = losers_of(make.now.history, base.id, make.fingerprint, "own plan")
        if base.model == make.fingerprint or tried:
            return None
        policy, _ = make.planner.first_policy()
        made = self._told(self.candidate(policy, Step(), "own plan"))
        promise = rival.candidate.expected_gain if rival and rival.candidate else self.least
        swung = wild(self.incumbent) or limit_cycle(self.incumbent, make.planner.task)
        better = swung or self._worth(made) > max(promise, self.least)
        proposal = make.checked(make.with_margin(made, self.real)) if better else None
        return proposal if proposal is not None and proposal.candidate is not None else None

    def _worth(self, made: Candidate) -> float:
        """What an own plan is likely to gain: the larger of what two models say.

        Trials that swung make every model that replays them doubtful. A changed model that
        foretells the incumbent without its bias is believed over that doubt, less what it is off
        by there, where the grounded one promises a gain too (or a drift car flew off), and unless
        it is little: its own plan always promises something in it.
        """
        plainly = self._plain_gain(made) if made.predicted_gain > self.least else None
        sure = -np.inf if plainly is None else plainly - self._plain_off
        little = sure <= LITTLE * -self.incumbent.utility
        return made.expected_gain if little else max(made.expected_gain, sure)


@dataclass(frozen=True, eq=False)
class Maker:
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
        caution: float | None = None,
    ) -> Candidate:
        """A candidate; its gains are designed as gently as its incumbent's, or by `caution`."""
        base, policy = self.now.incumbent, self.planner.narrowed(policy)
        if caution is None:
            follows = base is not None and base.candidate.base and way != "own plan"
            caution = base.candidate.caution if base and follows else self.now.caution
        if caution and base is not None:
            policy = self._gently(policy, problem, caution)
        made = Candidate(
            id=self.identity,
            policy=policy,
            iteration=0 if base is None else self.now.iteration + 1,
            alpha=step.alpha,
            damping=step.damping,
            base="" if base is None else base.candidate.id,
            model=self.fingerprint,
            predicted_states=policy.feedforward,
            predicted_inputs=policy.feedforward,
            predicted_utility=already,
            caution=caution,
            way=way,
        )
        return self.foretold(made, policy, problem, already)

    def foretold(
        self, made: Candidate, policy: Policy, problem: Problem, already: float
    ) -> Candidate:
        """A candidate with this policy and what a model predicts of it."""
        run = predicted(problem, policy)
        return replace(
            made,
            policy=policy,
            predicted_gain=run.utility - already,
            predicted_states=run.states[:, : self.planner.task.model.n],
            predicted_inputs=run.inputs,
            predicted_utility=run.utility,
        )

    def gentler(self, incumbent: Tried) -> Candidate | None:
        """The incumbent's plan with gentler gains, where its loop was unstable on the robot.

        High gains and a delay that the model lacks make a limit cycle, which no step along a
        direction leaves: the grounded model replays it, and has no delay to blame. An input that
        swings from limit to limit asks for far less gain. Else it may be noise that high gains
        carry, and half of them are still needed.
        """
        own = incumbent.candidate
        lost = losers_of(self.now.history, own.id, self.fingerprint, "gentler gains")
        if lost or own.policy.gain is None or own.model != self.fingerprint:
            return None
        if not limit_cycle(incumbent, self.planner.task):
            return None
        problem, real = self.planner.plan.problem(exact=True), incumbent.utility
        caution = own.caution + 1.0
        if not between_limits(incumbent, self.planner.task):
            less = own.caution + np.arange(1, FINE) / FINE
            most = HALF * _gain(own.policy)
            few = (c for c in less if _gain(self._gently(own.policy, problem, c)) < most)
            caution = float(next(few, caution))
        return self.candidate(own.policy, problem, Step(), real, "gentler gains", caution)

    def _gently(self, policy: Policy, problem: Problem, caution: float) -> Policy:
        """The same run with the gains of a regulator whose inputs cost GENTLER ** caution more."""
        if policy.gain is None:
            return policy
        run, gentle = predicted(problem, policy), self.planner.dearer(problem, GENTLER**caution)
        found = ddp.sweep(gentle, run.z, run.inputs)
        if not (found.ok and np.isfinite(run.z).all()):
            return policy
        plan, columns = self.planner.plan, base_columns(problem, self.planner.plan)
        K = measured_gains(gentle, run.z, run.inputs, found.gains.K, self.planner.task.model.n)
        made = plan.policy(run.inputs, K[:, :, columns], run.z[:-1, columns])
        return self.planner.narrowed(made)

    def with_margin(self, made: Candidate, problem: Problem) -> Candidate:
        """The same run with gains that hold under worse conditions, see `margin`."""
        own = made.policy
        if own.gain is None or not self.planner.needs_margin:
            return made
        gently, loose = partial(self._gently, own, problem), self.planner.loosened(problem)
        new = steadied(problem, own, gently, loose)
        return made if new is own else self.foretold(made, new, problem, made.expected_of_base)

    def checked(self, made: Candidate) -> Proposal:
        """A candidate that is finite, inside the limits and predicted to stay safe; or none."""
        task, history = self.planner.task, self.now.history
        if not (found := objections(task, made, spread(task, history, self.fingerprint))):
            return Proposal(self.now, made, is_new=True)
        stopped = replace(self.now, phase="stopped", sentence=found[0], ending="not allowed")
        return Proposal(stopped, None, is_new=False, notes=tuple(found), refused=made)


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Result):
    """What to run next, or why nothing is: `candidate` is None when the search has ended."""

    standing: Standing
    candidate: Candidate | None
    is_new: bool
    notes: tuple[str, ...] = ()
    refused: Candidate | None = None  # what `notes` speak against

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
        best = document(best_utility=now.incumbent and now.incumbent.utility, new=self.is_new)
        return known | best if made else known


def _gain(policy: Policy) -> float:
    """The mean size of the feedback's gains."""
    return 0.0 if policy.gain is None else float(np.abs(policy.gain).mean())
