"""Blind cases: a crude model, simulated real trials, and a label that is sealed separately.

A case is data; the command line writes it as a workspace of MCAP trials. One seed determines
everything: the system, the task, rates, noise, number of trials, the effect and its size, from
barely visible to large.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from grounded.challenge import systems
from grounded.challenge.draws import JOINT, draw_effect, draw_withheld, values_of
from grounded.challenge.mechanism import Mechanism
from grounded.challenge.truth import Disturbance, Truth
from grounded.checks import known
from grounded.effects import Effect, ParamFamily, scales_of
from grounded.errors import needs
from grounded.frozen import Array
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial
from grounded.utility import Reward

Kind = Literal["single", "double", "none", "withheld"]
KINDS: tuple[Kind, ...] = ("single", "double", "none", "withheld")
NOISE_KINDS = ("white", "coloured", "heavy")


@dataclass(frozen=True, eq=False)
class Case:
    """One case. `task` is what the user has, with the crude model; `label` is sealed."""

    name: str
    system: str
    task: Task
    trials: tuple[Trial, ...]
    label: Mapping[str, Any] = field(default_factory=dict)


def make(
    kind: Kind,
    count: int,
    seed: int,
    *,
    only: str | None = None,
    groups: Sequence[str] = ("own",),
    param_error: float | None = None,
    noise: str | None = None,
) -> Iterator[Case]:
    """Yield cases of a kind, one by one.

    Args:
        kind: single, double, none or withheld.
        count: number of cases.
        seed: determines everything.
        only: name of one system instead of all.
        groups: groups of systems (`systems.GROUPS`); "own" makes half of the cases if there are
            others.
        param_error: relative errors of the model's parameters (uniform), instead of a random third
            of the cases with 5 %.
        noise: "white", "coloured" or "heavy", instead of mostly white (of all three for "none").
    """
    known("kind", [kind], KINDS, "the challenge")
    if only is not None:
        known("system", [only], systems.SYSTEMS, "the challenge")
    share = shares_of(groups)
    if only is None and "mujoco" in groups:
        needs("mujoco")
    for i in range(count):
        rng = np.random.default_rng([seed, KINDS.index(kind), i])
        name = only or str(rng.choice(list(share), p=list(share.values())))
        case = None
        while case is None:
            case = _case(f"{kind}-{i:04d}", kind, i, systems.SYSTEMS[name], rng, param_error, noise)
        yield case


def shares_of(groups: Sequence[str]) -> dict[str, float]:
    """Return the probability of each system."""
    known("group", groups or [""], systems.GROUPS, "the challenge")
    weight = {g: max(len(groups) - 1, 1) if g == "own" else 1 for g in groups}
    total = sum(weight.values())
    return {
        name: part * weight[g] / total for g in weight for name, part in systems.GROUPS[g].items()
    }


def sealed(label: Mapping[str, Any]) -> str:
    """Return the hash under which a label is published before it is opened."""
    return hashlib.sha256(json.dumps(label, sort_keys=True).encode()).hexdigest()


def _case(
    name: str,
    kind: Kind,
    index: int,
    system: systems.SystemUnderTest,
    rng: np.random.Generator,
    param_error: float | None,
    noise: str | None,
) -> Case | None:
    """Draw a case; None if a mechanism left its target, since nobody would keep such runs."""
    dt = 1.0 / float(rng.choice(system.rates))
    duration = float(rng.uniform(*system.duration))
    drawn = NOISE_KINDS[index % 3] if kind == "none" else rng.choice(NOISE_KINDS, p=[0.8, 0.1, 0.1])
    times = np.arange(round(duration / dt), dtype=float) * dt
    count = int(rng.integers(3, 9))
    level, roughness = float(rng.choice([0.5, 1.0, 2.0])), float(rng.choice([0.5, 1.0, 3.0]))
    same_task = bool(rng.random() < 0.3)
    if (error := param_error) is None:
        error = 0.05 if kind == "single" and rng.random() < 0.33 else 0.0
    crude = _with_errors(system.model, error, rng)
    # the last two runs are in no case, but the numbers drawn for them are in the seeds of all sets
    plans = _plans(system, crude, times, count + 2, same_task, rng)
    disturbance = Disturbance(
        {k: v * roughness for k, v in system.process.items()},
        {k: v * level for k, v in system.measurement.items()},
        noise or str(drawn),
        grows=system.grows,
    )
    truth, label = _truth(kind, system, plans, dt, rng)
    truth = replace(truth, disturbance=disturbance, latency=system.latency)
    runs = [_run(system, truth, plan, dt, rng) for plan in plans]
    if system.built and any(map(partial(_lost, crude), runs, plans)):
        return None
    label |= {"noise": disturbance.kind, "level": level, "roughness": roughness}
    label |= {"param_error": error, "system": system.name, "kind": kind, "case": name}
    ones, none = np.ones(crude.n), np.zeros(crude.m)
    task = Task(
        model=crude,
        dt=dt,
        target=plans[0][2],
        reward=Reward(ones, 0 * ones, none, none),
        start=plans[0][1],
        past=none,
        low=system.low,
        high=system.high,
        latency=np.array(system.latency or none),
    )
    return Case(name, system.name, task, tuple(runs[:count]), label)


def _with_errors(model: Model, error: float, rng: np.random.Generator) -> Model:
    if error == 0:
        return model
    factors = 1 + error * rng.uniform(-1, 1, len(model.params))
    names = zip(model.params.items(), factors, strict=True)
    return model.with_values({n: p.value * float(f) for (n, p), f in names if p.uncertain})


LOST = 2.0  # distance from the target [rad or m]


def _lost(model: Model, trial: Trial, plan: Plan) -> bool:
    """Check whether a position went far from its target."""
    error = model.difference(trial.states, plan[2])[:, : model.n // 2]
    return not np.abs(error).max() < LOST


Plan = tuple[Array, Array, Array, Array]  # inputs (T, m), start (n,), target (T + 1, n), gains


def _plans(
    system: systems.SystemUnderTest,
    crude: Model,
    t: Array,
    count: int,
    same_task: bool,
    rng: np.random.Generator,
) -> list[Plan]:
    """Draw a manoeuvre for each trial, or one for all, inputs slightly varied."""
    found: list[Plan] = []
    for i in range(count):
        if i == 0 or not same_task:
            u, start = system.manoeuvre(rng, t, crude)
        else:
            spread = system.bend * (system.high - system.low)
            bend = np.column_stack([systems.wave(rng, t, 2, 0.1, 0.5) for _ in range(crude.m)])
            u, start = np.clip(found[0][0] + spread * bend, system.low, system.high), found[0][1]
        found.append((u, start, *systems.regulator(system, crude, u, start, float(t[1]))))
    return found


def _run(
    system: systems.SystemUnderTest, truth: Truth, plan: Plan, dt: float, rng: np.random.Generator
) -> Trial:
    u, start, target, gains = plan
    model = truth.model

    def control(t: int, y: Array) -> Array:
        error = np.clip(model.difference(y, target[t]), -2.0, 2.0)
        return np.asarray(np.clip(u[t] + gains[t] @ error, system.low, system.high))

    held = u[0] if system.settled else np.zeros(model.m)
    wobble = np.array([truth.disturbance.measurement.get(n, 0.0) for n in model.state_names])
    first = start + wobble * rng.standard_normal(model.n)
    return truth.run(rng, control, first, held, len(u), dt)


def _truth(
    kind: Kind,
    system: systems.SystemUnderTest,
    plans: list[Plan],
    dt: float,
    rng: np.random.Generator,
) -> tuple[Truth, dict[str, Any]]:
    """Return the real system without its disturbance, and its label."""
    model, duration, built = system.model, len(plans[0][0]) * dt, system.built is not None
    inputs, states = (np.concatenate([plan[k] for plan in plans]) for k in (0, 2))
    if kind == "withheld":
        moved = np.diff(states[:, model.state_names.index(system.driven)])
        rate = max(float(np.quantile(np.abs(moved), 0.9)) / dt, 0.3)
        peak = np.abs(inputs - inputs.mean(axis=0)).max(axis=0) + 0.5 * np.abs(inputs).max(axis=0)
        hidden = draw_withheld(rng, model, peak, system.driven, rate, duration, built)
        truth = Truth(model, actuators=hidden.actuators, rates=hidden.rates)
        label = {"name": hidden.name, "target": hidden.target, "params": hidden.params}
        return _built(system, truth, hidden.joint), {"effects": [], "withheld": label}
    scales = scales_of(model, states, inputs, dt, duration)
    effects: list[tuple[Effect, dict[str, float]]] = []
    while len(effects) < {"none": 0, "single": 1, "double": 2}[kind]:
        effect = draw_effect(model, scales, rng, JOINT if built else ())
        if effect.name not in [e.name for e, _ in effects]:
            effects.append((effect, values_of(effect, scales, rng, states, built)))
    shifts = {e.site.target: v["d"] for e, v in effects if isinstance(e.family, ParamFamily)}
    shifted = {n: model.params[n].value + d for n, d in shifts.items()}
    own = model.with_values(shifted) if shifts else model
    acting = tuple((e, v) for e, v in effects if not isinstance(e.family, ParamFamily))
    named = [{"effect": e.name, "params": dict(v)} for e, v in effects]
    return _built(system, Truth(own, acting)), {"effects": named}


INSIDE = {"joint_friction": "friction", "added_inertia": "armature", "first_order_lag": "lag"}


def _built(
    system: systems.SystemUnderTest, truth: Truth, more: Mapping[str, float] | None = None
) -> Truth:
    """Build the system in MuJoCo if it has a model there, with the effects of its joints inside."""
    if system.built is None:
        return truth
    true = dict(zip(truth.model.param_names, map(float, truth.model.values), strict=True))
    part: dict[str, dict[str, float]] = {kind: {} for kind in INSIDE.values()} | {"true": true}
    for effect, values in truth.effects:
        if (kind := INSIDE.get(effect.family.name)) is not None:
            size = next(values[q] for q in ("c", "J", "tau") if q in values)
            for name in effect.site.targets:
                part[kind][name.partition("<-")[0]] = size
    outside = tuple((e, v) for e, v in truth.effects if e.family.name not in INSIDE)
    built = partial(Mechanism, system.built, part, more or {})
    return replace(truth, effects=outside, mechanism=built)
