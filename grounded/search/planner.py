"""Planner: the task used for planning, beside the task that judges the robot's trials.

They differ once effects are adopted: a lag, a backlash or a rate limit gives the model memory
states, which the robot does not measure. Trials are LIFTED to the planning model (the memory
follows from the commands). Policies are NARROWED to what the robot measures (their gains are
designed for that, `measured_gains`; the memory's part of the feed-forward stays). The predicted run
is that of the narrowed policy.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from grounded.checks import known
from grounded.model import Model
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.compile.problem import Problem
    from grounded.effects import Effect, Library
    from grounded.rollout import Rollout
    from grounded.search.first_policy import Tick
    from grounded.solve.ddp import Solution


GOLDEN = 0.6180339887498949  # multiples of it, modulo 1, cover an interval evenly (Weyl 1916)
LOOSE = 64.0  # factor on the speed a dry friction builds up over: it then hardly damps


@dataclass(frozen=True, eq=False)
class Planner:
    """The task that judges trials, and the task used for planning.

    Args:
        task: judges the trials; its states are those that the robot measures.
        plan: has the planning model, whose first states are the task's.
        widths: names of parameters of the planning model that are speeds over which a dry friction
            builds up.
        plays: names of its parameters that are widths of a play.
    """

    task: Task
    plan: Task
    widths: tuple[str, ...] = ()
    plays: tuple[str, ...] = ()

    @cached_property
    def fingerprint(self) -> str:
        """Fingerprint of the planning model, see `model_fingerprint`."""
        return model_fingerprint(self.plan)

    def dearer(self, problem: Problem, factor: float) -> Problem:
        """Return the problem, `loose`, with `factor` the input weights."""
        easier = dataclasses.replace(problem, p=self.loose.model.values)
        weight = factor * easier.input_weight + (factor - 1) * easier.change_weight
        return dataclasses.replace(easier, input_weight=weight)

    @cached_property
    def loose(self) -> Task:
        """The planning task without play, and with dry friction that builds up slowly."""
        model = self.engaged.model
        slow = {name: LOOSE * model.params[name].value for name in self.widths}
        return self.engaged.with_model(model.with_values(slow)) if slow else self.engaged

    @cached_property
    def engaged(self) -> Task:
        """The planning task without play, which plans are made with.

        Within a play an input has no slope: gains vanish at most steps and are huge at a few, so
        that the feedback is nearly switched off. Such plans cost a car with 20 mrad of play four
        times as much as plans without it. A trial's bias replays what the play did.
        """
        if not self.plays:
            return self.plan
        model = self.plan.model.with_values(dict.fromkeys(self.plays, 0.0))
        return self.plan.with_model(model)

    def lift(self, trial: Trial) -> Trial:
        """Return a trial with the planning model's memory states added."""
        plan, base = self.plan.model, self.task.model
        if plan.n == base.n:
            return trial
        from grounded.effects import memory_of

        if trial.start_inputs is None:
            trial = dataclasses.replace(trial, start_inputs=self.task.past)
        states = np.hstack([trial.states, memory_of(plan, base, trial, self.plan.latency)])
        return dataclasses.replace(trial, states=states, state_names=plan.state_names)

    def widened(self, policy: Policy) -> Policy:
        """Return a robot's policy over the planning model's z."""
        from grounded.compile.problem import deepest

        model = self.plan.model
        angles = tuple(bool(a) for a in model.angle_mask)
        depths = deepest(self.plan.problem().depths, policy.depths)
        return policy.laid_out(model.state_names, angles, depths)

    def feeding_back(self, policies: Iterable[Policy]) -> Planner:
        """Return the planner with as many past inputs in z as any of the policies feeds back.

        They may have been made with a longer latency. Without the gains on the oldest inputs such a
        loop would seem unstable.
        """
        from grounded.compile.problem import deepest

        own = depths = self.plan.problem().depths
        for policy in policies:
            depths = deepest(depths, policy.depths)
        if depths == own:
            return self
        return dataclasses.replace(self, plan=dataclasses.replace(self.plan, fed_back=depths))

    def narrowed(self, policy: Policy) -> Policy:
        """Return a planned policy over the states that the robot measures and the inputs sent."""
        model = self.task.model
        angles = tuple(bool(a) for a in model.angle_mask)
        return policy.laid_out(model.state_names, angles, policy.depths)

    def first_policy(self, caution: int = 0, tick: Tick | None = None) -> tuple[Policy, Solution]:
        """Return the planning model's own policy, with gains on measured states only.

        With dry friction these are designed as if it built up slowly: while a joint sticks, it
        needs none, and would have none once it slips.

        Args:
            caution: how often a first policy has crashed.
            tick: called with a line of progress.
        """
        from grounded.search.first_policy import cautious, first_policy
        from grounded.solve.ddp import sweep
        from grounded.solve.measured import measured_gains

        policy, found = first_policy(self.engaged, caution, tick)
        if policy.gain is None or (self.plan.model.n == self.task.model.n and not self.widths):
            return policy, found
        task, n, K = cautious(self.engaged, caution), self.task.model.n, found.K
        problem = task.problem()
        if self.widths:
            problem = self.dearer(task.problem(exact=True), 1.0)
            K = sweep(problem, found.z, found.u).gains.K
        K = measured_gains(problem, found.z, found.u, K, n)
        return dataclasses.replace(policy, gain=K), found

    def with_model(self, model: Model) -> Planner:
        """Return the planner with other parameter values of the planning model."""
        return dataclasses.replace(self, plan=self.plan.with_model(model))


def model_fingerprint(task: Task) -> str:
    """Return a hash of the planning model's values, latency, smoothing and predictions.

    It has 16 hex digits. Predictions at fixed points stand for the code of the dynamics.
    """
    model = task.model
    assert task.latency is not None
    digest = hashlib.sha256()
    digest.update(repr((model.state_names, model.input_names, model.param_names)).encode())
    around = np.arange(1, 8 * (model.n + model.m) + 1) * GOLDEN % 1.0 - 0.5
    x = task.start + around[: 8 * model.n].reshape(8, model.n)
    u = task.past + around[8 * model.n :].reshape(8, model.m)
    u = np.clip(u, task.low, task.high)
    with np.errstate(all="ignore"):
        moved = model.steps(x, u, task.dt)
    for array in (
        model.values,
        task.latency / task.dt,
        np.array([task.smoothing]),
        np.round(moved, 9),
    ):
        digest.update(np.ascontiguousarray(array + 0.0).tobytes())
    return digest.hexdigest()[:16]


def predicted(problem: Problem, policy: Policy) -> Rollout:
    """Simulate a robot's policy in a model that may have more states than the robot measures."""
    from grounded.compile.problem import deepest
    from grounded.rollout import simulate

    angles = tuple(map(bool, problem.angles))
    depths = deepest(problem.depths, policy.depths)
    return simulate(problem, policy.laid_out(problem.system.states, angles, depths))


Given = Mapping[str, float]  # an effect's quantities by name


def planner_with(
    task: Task,
    effects: Sequence[tuple[str, Given]],
    library: Library | None = None,
    checked: Callable[[Effect, Given], Given] | None = None,
) -> Planner:
    """Return the planner of a task with effects added to its model.

    A pure delay becomes latency of the task, a queue of inputs that the robot's runner keeps. Every
    other effect wraps the model, with memory states if it has memory. If an input also has a
    nonlinear effect (a dead zone, a rate limit), its latency has whole steps only, since the mean
    of two commands, bent, is not the mean of what was bent. For the remaining fraction, the model's
    step is made in parts.

    Args:
        task: the manoeuvre, with the original model.
        effects: names, `family:target`, and quantities, in the order in which the effects act.
        library: the library of effect families; None for the built-in families.
        checked: function (effect, quantities) -> complete quantities within bounds; None for
            `Effect.complete`.

    Raises:
        GroundedError: for an unknown effect, or a quantity that is missing or unknown.
    """
    from grounded.effects import Library, memory_start, param_name, wrap, wrapping_order
    from grounded.effects.family import Effect, InputFamily, MemoryFamily, Scales, Site
    from grounded.effects.wrap import late_by

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
    for i in wrapping_order(families):
        if families[i].name == "delay":
            continue
        name, values = effects[i]
        effect = library.effect(name, model)
        model = wrap(effect, checked(effect, values), task.dt)
    rest = zip(model.input_names, part.tolist(), strict=True)
    model = late_by(model, {name: by for name, by in rest if by > 0}, task.dt)
    latency -= part
    widths = tuple(param_name(name, "width") for name, values in effects if "width" in values)
    plays = tuple(
        param_name(name, "b")
        for (name, _), family in zip(effects, families, strict=True)
        if family.name == "backlash"
    )
    # The states that effects added begin as they are while the held input is sent, and are free.
    names, extra = (task.model.state_names, task.model.input_names), model.n - task.model.n
    held = Trial(task.start[None], task.past[None][:0], task.dt, *names, start_inputs=task.past)
    memory = memory_start(model, task.model, held) if extra else np.zeros(0)
    free, weights = np.full(extra, np.inf), task.reward
    assert task.safety_low is not None and task.safety_high is not None
    plan = dataclasses.replace(
        task,
        model=model,
        latency=latency,
        target=np.hstack([task.target, np.full((task.horizon + 1, extra), np.nan)]),
        reward=dataclasses.replace(
            weights,
            state=np.append(weights.state, 0 * memory),
            terminal=np.append(weights.terminal, 0 * memory),
        ),
        start=np.append(task.start, memory),
        safety_low=np.append(task.safety_low, -free),
        safety_high=np.append(task.safety_high, free),
    )
    return Planner(task, plan, widths, plays)


WHOLE = 1e-6  # tolerance, as a fraction of a step, for whole numbers of steps


def _input(task: Task, name: str, target: str) -> int:
    known("input", [target], task.model.input_names, f"effect '{name}'")
    return task.model.input_names.index(target)
