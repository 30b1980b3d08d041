"""Planner: the task as the search plans it, beside the task as the robot's trials judge it.

They differ once effects are adopted: a lag, a backlash or a rate limit gives the model memory
states that no sensor of the robot knows. Trials are LIFTED to the planning model (the memory
follows from the commands), policies are NARROWED to what the robot measures (their gains are made
for that, `measured_gains`; the memory's part of the feed-forward stays), and the predicted run is
the narrowed policy's.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.compile import Problem
from grounded.errors import GroundedError
from grounded.frozen import Array
from grounded.model import Model
from grounded.policy import Policy
from grounded.rollout import Rollout, simulate
from grounded.solve.measured import measured_gains
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

if TYPE_CHECKING:
    from grounded.effects import Effect, Library
    from grounded.search.first_policy import Tick
    from grounded.solve.ddp import Solution


DEARER = (1.0, 10.0, 100.0, 1000.0)  # times what inputs cost: gains that are tried
LOOSE = 64.0  # times the speed a dry friction builds up over: it damps what moves next to nothing


@dataclass(frozen=True, eq=False)
class Planner:
    """`task` judges; `plan` has the planning model, whose first states are the task's."""

    task: Task
    plan: Task
    widths: tuple[str, ...] = ()  # parameters of the plan's model: speeds a friction builds up over

    @cached_property
    def fingerprint(self) -> str:
        """Of the model that plans, see `model_fingerprint`."""
        return model_fingerprint(self.plan)

    @property
    def needs_margin(self) -> bool:
        """Whether gains may rely on what a robot has not: no delay, all memory shown, no slip."""
        assert self.plan.latency is not None
        remembers = self.plan.model.n > self.task.model.n
        return remembers or bool(self.plan.latency.any() or self.widths)

    def loosened(self, problem: Problem) -> Problem | None:
        """The plan's problem with dry frictions that build up slowly; None where it has none."""
        return dataclasses.replace(problem, p=self.loose.model.values) if self.widths else None

    def dearer(self, problem: Problem, factor: float) -> Problem:
        """The same, if it has any, whose inputs cost `factor` times as much: for gentler gains."""
        easier = self.loosened(problem) or problem
        weight = factor * easier.input_weight + (factor - 1) * easier.change_weight
        return dataclasses.replace(easier, input_weight=weight)

    @cached_property
    def loose(self) -> Task:
        """The plan's task with such frictions; its own where it has none."""
        model = self.plan.model
        slow = {name: LOOSE * model.params[name].value for name in self.widths}
        return self.plan.with_model(model.with_values(slow)) if slow else self.plan

    @cached_property
    def aim(self) -> Task:
        """The plan's task, whose end is asked of true values where the log of a state is late.

        What a filter shows is judged, but a plan that ends by it kicks in its last steps: then the
        filter shows rest, and the robot moves.
        """
        n, names = self.task.model.n, self.plan.model.state_names
        if len(names) == n:
            return self.plan
        from grounded.effects.memory import true_values

        terminal, target = self.plan.reward.terminal.copy(), self.plan.target.copy()
        for true, logged in true_values(names, names[n:]).items():
            if terminal[logged] > 0:
                terminal[true], terminal[logged] = terminal[logged], 0.0
                target[:, true] = target[:, logged]
        goals = dataclasses.replace(self.plan.reward, terminal=terminal)
        return dataclasses.replace(self.plan, target=target, reward=goals)

    def lift(self, trial: Trial) -> Trial:
        """A trial with the planning model's memory states beside its own."""
        plan, base = self.plan.model, self.task.model
        if plan.n == base.n:
            return trial
        from grounded.effects import memory_of

        if trial.start_inputs is None:
            trial = dataclasses.replace(trial, start_inputs=self.task.past)
        states = np.hstack([trial.states, memory_of(plan, base, trial, self.plan.latency)])
        return dataclasses.replace(trial, states=states, state_names=plan.state_names)

    def widened(self, policy: Policy) -> Policy:
        """A robot's policy over the planning model's z."""
        model = self.plan.model
        angles = tuple(bool(a) for a in model.angle_mask)
        return policy.laid_out(model.state_names, angles, self.plan.problem().depths)

    def narrowed(self, policy: Policy) -> Policy:
        """A planned policy over what the robot measures and sent."""
        model = self.task.model
        angles = tuple(bool(a) for a in model.angle_mask)
        return policy.laid_out(model.state_names, angles, policy.depths)

    def first_policy(self, caution: int = 0, tick: Tick | None = None) -> tuple[Policy, Solution]:
        """The planning model's own policy with gains on what the robot measures alone.

        Of several, whose predicted run costs least: made where kinks are blended; or where dry
        friction does not count, for inputs that are dearer and dearer.
        """
        from grounded.search.first_policy import cautious, first_policy
        from grounded.solve.ddp import sweep

        policy, found = first_policy(self.aim, caution, tick, self.widths)
        if self.plan.model.n == self.task.model.n or policy.gain is None:
            return policy, found
        task, n = cautious(self.aim, caution), self.task.model.n
        made = [measured_gains(task.problem(), found.z, found.u, found.K, n)]
        exact = self.plan.problem(exact=True)
        for factor in DEARER if self.widths else ():
            dear = self.dearer(task.problem(exact=True), factor)
            K = sweep(dear, found.z, found.u).gains.K
            made.append(measured_gains(dear, found.z, found.u, K, n))
        policies = [dataclasses.replace(policy, gain=K) for K in made]
        return max(policies, key=lambda one: predicted(exact, one).utility), found

    def with_model(self, model: Model) -> Planner:
        """The same with other parameter values of the planning model."""
        return dataclasses.replace(self, plan=self.plan.with_model(model))


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


def predicted(problem: Problem, policy: Policy) -> Rollout:
    """A robot's policy in a model that may have more states than it measures."""
    angles = tuple(map(bool, problem.angles))
    return simulate(problem, policy.laid_out(problem.system.states, angles, problem.depths))


Given = Mapping[str, float]  # an effect's quantities by name


def planner_with(
    task: Task,
    effects: Sequence[tuple[str, Given]],
    library: Library | None = None,
    checked: Callable[[Effect, Given], Given] | None = None,
) -> Planner:
    """The planner of a task whose model got these effects, in the order in which they act.

    A pure delay becomes latency of the task, a queue that the robot's runner knows; everything else
    wraps the model, with memory states where the effect has a memory. Of an input that is bent on
    its way (a dead zone, a limit of its rate) the latency has whole steps alone: what is left of a
    step acts behind the bend, since the mean of two commands, bent, is not the mean of both bent.

    Args:
        task: what is to be done, with the model as it was.
        effects: names, `family:target`, and quantities.
        library: where the families are; None: the built-in ones.
        checked: an effect's quantities, all of them and in bounds; None: `Effect.complete`.

    Raises:
        GroundedError: for an unknown effect, or a quantity that is missing or unknown.
    """
    from grounded.effects import Library, param_name, wrap
    from grounded.effects.family import Effect, InputFamily, MemoryFamily, Scales, Site
    from grounded.effects.order import wrapping_order

    library, checked = library or Library(), checked or Effect.complete
    assert task.latency is not None
    model, latency, bent = task.model, np.array(task.latency), np.zeros(task.model.m, bool)
    families = [library.family(name.partition(":")[0]) for name, _ in effects]
    for (name, values), family in zip(effects, families, strict=True):
        if not isinstance(family, InputFamily | MemoryFamily):
            continue
        targets = tuple(name.partition(":")[2].split("+"))
        reached = [_input(task, name, one) for one in targets]
        if family.name == "delay":
            site = Site(task.model, targets, Scales())
            latency[reached] += checked(family.at(site), values)["d"]
        else:
            bent[reached] |= not family.linear
    part = np.where(bent, latency - task.dt * np.floor(latency / task.dt + WHOLE), 0.0)
    part[part < WHOLE * task.dt] = 0.0
    order = wrapping_order(families)
    inputs = [i for i in order if isinstance(families[i], InputFamily | MemoryFamily)]
    for i in order:
        if i in inputs[:1]:
            model = _late_by(model, part, task.dt)
        if families[i].name == "delay":
            continue
        name, values = effects[i]
        effect = library.effect(name, model)
        model = wrap(effect, checked(effect, values), task.dt)
    latency -= part
    widths = tuple(param_name(name, "width") for name, values in effects if "width" in values)
    return dataclasses.replace(planner_for(task, model, latency), widths=widths)


WHOLE = 1e-6  # of a step: closer to whole steps is whole


def _late_by(model: Model, late: Array, dt: float) -> Model:
    """The model whose inputs arrive parts of a step late, (m,) [s]: constants, not estimated."""
    from grounded.effects import Library, wrap
    from grounded.effects.family import MemoryFamily

    for name, by in zip(model.input_names, late.tolist(), strict=True):
        if by > 0:
            effect = Library().effect(f"delay:{name}", model)
            assert isinstance(effect.family, MemoryFamily)
            once = dataclasses.replace(effect.family, depth=lambda values, dt: 1)
            fixed = tuple(dataclasses.replace(q, fixed=True, start=by) for q in effect.quantities)
            effect = dataclasses.replace(effect, family=once, quantities=fixed)
            model = wrap(effect, {"d": by}, dt)
    return model


def _input(task: Task, name: str, target: str) -> int:
    if target not in task.model.input_names:
        raise GroundedError(f"effect '{name}': '{target}' is not an input of the model")
    return task.model.input_names.index(target)


def planner_for(task: Task, model: Model, latency: np.ndarray) -> Planner:
    """A planner with another model, whose first states are the task's, and another latency (m,)."""
    extra = model.n - task.model.n
    held = Trial(
        states=task.start[None],
        inputs=np.zeros((0, task.model.m)),
        dt=task.dt,
        state_names=task.model.state_names,
        input_names=task.model.input_names,
        start_inputs=task.past,
    )
    memory = np.zeros(0)
    if extra:  # effects take a while to import, and most models have none
        from grounded.effects import memory_start

        memory = memory_start(model, task.model, held)
    nothing, reward = np.zeros(extra), task.reward
    assert task.safety_low is not None and task.safety_high is not None
    plan = dataclasses.replace(
        task,
        model=model,
        latency=latency,
        target=np.hstack([task.target, np.full((task.horizon + 1, extra), np.nan)]),
        reward=Reward(
            np.append(reward.state, nothing),
            np.append(reward.terminal, nothing),
            reward.input,
            reward.input_change,
        ),
        start=np.append(task.start, memory),
        safety_low=np.append(task.safety_low, np.full(extra, -np.inf)),
        safety_high=np.append(task.safety_high, np.full(extra, np.inf)),
    )
    return Planner(task, plan)
