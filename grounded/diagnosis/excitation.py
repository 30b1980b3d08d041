"""What to run next: the probe that tells two explanations apart best.

Two hypotheses A and B tie on the trials so far. Each of a set of probes (the base policy with a
staircase, steps, doublets, a sweep of frequencies or a slow ramp added to one input) is run in the
model with A; then B, its values and all calibrated parameters free to adapt, tries to explain that
run through the same filter and noise. What it fails to explain is the evidence of the probe:

    E[log p(y | A) - log p(y | B)] = 1/2 |whitened innovations of B on A's run|^2

The trials so far measure how far that can be believed: their own commands would have told the two
apart by some nats, and have by few; whatever a probe is expected to tell is scaled alike.

Where nothing ties, the probe teaches most about the values that are claimed or calibrated: from
the information F of the trials so far and J of its run, filtered alike, the expected gain is

    1/2 log det(F + J) / det F        and variances shrink as diag (F + J)^-1 to diag F^-1

The probe stays inside the inputs' limits, and both hypotheses' runs inside the task's safety.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from grounded.diagnosis.hypotheses.explored import TIE
from grounded.diagnosis.likelihood.data import Data, prepare, shifted
from grounded.diagnosis.likelihood.fitted import calibrated
from grounded.diagnosis.likelihood.hypothesis import Hypothesis, param_scale
from grounded.diagnosis.likelihood.noise import NoiseModel, Structure
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.refine import refine
from grounded.diagnosis.report import Diagnosis, Estimate
from grounded.effects import Library, Scales, memory_start, scales_of, wrap, wrapping_order
from grounded.frozen import Array
from grounded.model import Model
from grounded.onboard import Runner
from grounded.policy import Policy
from grounded.task import Task
from grounded.trial import Trial

SIZES = (0.15, 0.35)  # of the input's range
NOTHING = 0.1  # nats: less is nothing that a trial could tell
REPLAYED = 4  # trials whose commands show what they should have told
ADAPTED = 12  # iterations in which a rival adapts to a run
TEACHES = 0.1  # of a value's standard deviation: a probe that takes off less teaches too little
LITTLE = 1e-6  # of a value's own information, and of its size


@dataclass(frozen=True, eq=False)
class Probe:
    """A runnable policy, the evidence it is expected to bring [nats], and what it does.

    `about`: the two effects that it tells apart, or the value that it teaches most of.
    `little`: that is too little to be worth a trial.
    """

    policy: Policy
    expected: float
    about: tuple[str, ...]
    sentence: str
    little: bool = False


@dataclass(frozen=True, eq=False)
class _Noise:
    """The noise of a diagnosis; nothing disturbs or measures `hidden` states, adopted memories."""

    model: NoiseModel
    hidden: tuple[str, ...]

    @classmethod
    def of(cls, model: Model, diagnosis: Diagnosis) -> _Noise:
        def logs(levels: Mapping[str, float]) -> Array:
            return np.array([2 * np.log(levels.get(n, 0.0) + 1e-12) for n in model.state_names])

        known = diagnosis.noise
        q, r = logs(known.process), logs(known.measurement)
        noise = NoiseModel(Structure(), q, r, q.copy(), np.full(model.n, -60.0))
        return cls(noise, tuple(n for n in model.state_names if n not in known.process))

    def data(self, task: Task, runs: Sequence[Trial]) -> Data:
        return prepare(task.model, runs, task.latency, task.past, self.hidden)


def probe(
    task: Task,
    policy: Policy,
    diagnosis: Diagnosis,
    trials: Sequence[Trial],
    library: Library | None = None,
) -> Probe | None:
    """The best probe for the first group that the data can't tell apart, or else for all values.

    None where neither ties nor values are, or none is safe.

    Args:
        task: limits, start, safety, latency.
        policy: what the probe is added to, usually the best policy so far.
        diagnosis: names the group and the hypotheses' values.
        trials: the trials it was made from (for the sizes of signals).
        library: where the effects come from.
    """
    open_ = [g for g in diagnosis.indistinguishable if g not in diagnosis.equivalent]
    ties = [g for g in open_ if all(diagnosis.values(n) for n in g[:2])]
    if not ties:
        return _teaching(task, policy, diagnosis, trials, library or Library())
    group = ties[0]
    task, first, second = _rivals(task, diagnosis, trials, library or Library(), group[:2])
    noise = _Noise.of(task.model, diagnosis)
    again = [run for t in trials[-REPLAYED:] if (run := _run(task, first, policy, t)) is not None]
    if again:
        second = _adapted(task, again, second, noise)
    told = sum(_evidence(task, run, first, second, noise) for run in again)
    told *= len(trials) / max(len(again), 1)
    rows = [diagnosis.ranked(name) for name in group[:2]]
    apart = [row.evidence for row in rows if row is not None]
    trust = min(1.0, max(TIE, float(np.ptp(apart))) / max(told, 1e-12))
    best: tuple[float, Policy, str] | None = None
    for words, candidate in probes(policy, task.model, _inputs_of(task.model, group[:2])):
        runs = [_run(task, h, candidate) for h in (first, second)]
        if any(run is None or not _safe(task, run) for run in runs):
            continue
        assert runs[0] is not None and runs[1] is not None
        expected = trust * min(
            _evidence(task, runs[0], first, second, noise),
            _evidence(task, runs[1], second, first, noise),
        )
        if best is None or expected > best[0]:
            best = (expected, candidate, words)
    if best is None:
        return None
    expected, chosen, words = best
    if expected < NOTHING:
        same = f"no probe tells {group[0]} from {group[1]}: with other values of the rest"
        text = f"{same} they do the same"
        return Probe(chosen, expected, (group[0], group[1]), text, little=True)
    gain = f"{expected:,.{int(expected < 100)}f} nats"
    sentence = f"{words}: expected to tell {group[0]} from {group[1]} by {gain}" + (
        " (too little: try larger inputs or another manoeuvre)" if expected < TIE else ""
    )
    return Probe(chosen, expected, (group[0], group[1]), sentence)


def _teaching(
    task: Task, policy: Policy, diagnosis: Diagnosis, trials: Sequence[Trial], library: Library
) -> Probe | None:
    """The probe from which most is learnt about claimed and calibrated values."""
    known, task = _calibrated(task, diagnosis)
    scales, h = _scales(task, trials), Hypothesis()
    spreads: dict[str, tuple[float, str]] = {}  # by column: standard deviation, unit
    for name in (n for n in diagnosis.joining if not n.startswith("parameter:")):
        row, effect = diagnosis.ranked(name), library.effect(name, task.model, scales)
        if row is None:
            return None
        h = h.plus(effect, row.values)
        spreads |= {f"{q.name} of {name}": (row.params[q.name].std, q.unit) for q in effect.free}
    noise, best = _Noise.of(task.model, diagnosis), None
    data = noise.data(task, trials)
    sizes = {data.model.param_names[i]: float(param_scale(data.model)[i]) for i in calibrated(data)}
    if known:
        h = replace(h, shift=np.zeros(data.model.system.k), spread=1.0)
        stds = {n: known[n].std / s if n in known else 0.0 for n, s in sizes.items()}
        spreads |= {n: (stds[n], data.model.params[n].unit) for n in sizes}
    std = np.array([s if np.isfinite(s) else 0.0 for s, _ in spreads.values()])
    if not std.any():
        return None
    F = _information(task, trials, h, noise)
    if F.shape != (len(std), len(std)) or not np.isfinite(F).all():
        return None
    own = np.maximum(np.diag(F), 1 / np.maximum(std, LITTLE) ** 2)  # or what is known beforehand
    unit_of = 1 / np.sqrt(own)
    F = (F + np.diag(own - np.diag(F))) * np.outer(unit_of, unit_of) + LITTLE * np.eye(len(std))
    for words, candidate in probes(policy, task.model, range(task.model.m)):
        run = _run(task, h, candidate)
        if not _safe(task, run):
            continue
        assert run is not None
        J = _information(task, [run], h, noise)
        if J.shape != F.shape or not np.isfinite(J).all():
            continue
        after = F + J * np.outer(unit_of, unit_of)
        gain = 0.5 * float(np.linalg.slogdet(after)[1] - np.linalg.slogdet(F)[1])
        if best is None or gain > best[0]:
            left = np.diag(np.linalg.inv(after)) / np.diag(np.linalg.inv(F))
            best = (gain, candidate, words, np.sqrt(left))
    if best is None:
        return None
    gain, chosen, words, shrunk = best
    k = int(np.argmin(np.where(std > 0, shrunk, np.inf)))
    name = list(spreads)[k]
    unit = f" {spreads[name][1]}" * (spreads[name][1] != "1")
    now = float(std[k]) * sizes.get(name, 1.0)
    then = now * float(shrunk[k])
    sentence = f"{words}: would tell {name} to +- {then:.2g}{unit} (now +- {now:.2g}{unit})"
    if little := bool(shrunk[k] > 1 - TEACHES):
        sentence = f"no candidate inside the limits teaches much, not even {sentence}"
    return Probe(chosen, gain, (name,), sentence, little)


def _information(task: Task, runs: Sequence[Trial], h: Hypothesis, noise: _Noise) -> Array:
    """Fisher information (C, C) on a hypothesis' values that runs hold, or would."""
    data = noise.data(task, runs)
    start = [(h, noise.model, data.y.copy())]
    fits = refine(Predictor(data), start, iterations=1, fixed_noise=True)
    return np.asarray(fits[0].gram.sum(axis=0)) if fits else np.zeros((0, 0))


def probes(policy: Policy, model: Model, inputs: Sequence[int]) -> Iterator[tuple[str, Policy]]:
    """The base policy itself, then with each pattern added to each input."""
    yield "the base policy once more", policy
    t = np.arange(policy.horizon, dtype=float) * policy.dt
    for j in inputs:
        low, high = policy.low[j], policy.high[j]
        room = float(high - low) if np.isfinite(high - low) else 2.0
        limits = f" (limits {low:g} to {high:g})" * bool(np.isfinite(high - low))
        for size in SIZES:
            for words, shape in patterns(t):
                feedforward = policy.feedforward.copy()
                feedforward[:, j] = np.clip(feedforward[:, j] + size * room * shape, low, high)
                name = policy.input_names[j]
                unit = model.inputs[name]
                of = f"{size * room:.2g} {unit}" if unit != "1" else f"{size * room:.2g}{limits}"
                made = replace(policy, feedforward=feedforward)
                yield f"{words} of {of} added to {name}", made


def patterns(t: Any) -> list[tuple[str, Array]]:
    """Shapes of unit size over the times t (H,)."""
    T = float(t[-1]) + 1e-9
    phase = t / T
    stairs = np.round(4 * np.sin(2 * np.pi * phase)) / 4
    doublets = np.sign(np.sin(2 * np.pi * t / max(T / 5, 0.4)))
    sweep = np.sin(2 * np.pi * (0.2 * t + 0.5 * (2.0 - 0.2) / T * t**2))
    return [
        ("a slow ramp down", -phase),
        ("a slow ramp up", phase),
        ("a staircase", stairs),
        ("doublets", doublets),
        ("a sweep of frequencies", sweep),
        ("a pulse to the lower side", -((phase > 0.4) & (phase < 0.7)).astype(float)),
    ]


def _inputs_of(model: Model, names: Sequence[str]) -> list[int]:
    """Inputs that the tied effects act on; all of them where they act on states."""
    targets = {t for name in names for t in name.partition(":")[2].split("+")}
    own = [j for j, n in enumerate(model.input_names) if n in targets]
    return own or list(range(model.m))


def _calibrated(task: Task, diagnosis: Diagnosis) -> tuple[dict[str, Estimate], Task]:
    """The parameters that were calibrated, and the task with their values."""
    known = {n: e for n, e in diagnosis.parameters.items() if n in task.model.params}
    values = {n: e.value for n, e in known.items() if np.isfinite(e.value)}
    return known, task.with_model(task.model.with_values(values))


def _rivals(
    task: Task,
    diagnosis: Diagnosis,
    trials: Sequence[Trial],
    library: Library,
    pair: Sequence[str],
) -> tuple[Task, Hypothesis, Hypothesis]:
    """The calibrated task, and two hypotheses in which whatever was calibrated may still move."""
    known, task = _calibrated(task, diagnosis)
    scales, h = _scales(task, trials), Hypothesis()
    names = [name for name in diagnosis.joining if not name.startswith("parameter:")]
    names = names if pair[0] in names else [*names, pair[0]]
    if known:
        h = replace(h, shift=np.zeros(task.model.system.k), spread=1.0)
    one = other = h
    for name in (n for n in names if n != pair[1]):
        rival = pair[1] if name == pair[0] else name  # it acts where the other one does
        one = one.plus(library.effect(name, task.model, scales), diagnosis.values(name))
        other = other.plus(library.effect(rival, task.model, scales), diagnosis.values(rival))
    return task, one, other


def _adapted(task: Task, runs: list[Trial], h: Hypothesis, noise: _Noise) -> Hypothesis:
    """A hypothesis with the values that explain runs best: as the trials left it."""
    data = noise.data(task, runs)
    start = [(h, noise.model, data.y.copy())]
    fits = refine(Predictor(data), start, iterations=ADAPTED, fixed_noise=True)
    return fits[0].hypothesis if fits else h


def _scales(task: Task, trials: Sequence[Trial]) -> Scales:
    states = np.concatenate([trial.states for trial in trials])
    inputs = np.concatenate([trial.inputs for trial in trials])
    duration = max(trial.steps for trial in trials) * task.dt
    return scales_of(task.model, states, inputs, task.dt, duration)


def _run(task: Task, h: Hypothesis, policy: Policy, like: Trial | None = None) -> Trial | None:
    """A run of the policy in the model with a hypothesis, without noise; None if it diverges.

    With `like` the commands and the start of that trial take the policy's place.
    """
    model = _wrapped(task, h)
    assert task.latency is not None
    names = (task.model.state_names, task.model.input_names)
    nothing = np.empty((0, task.model.m))
    begin, held, steps = task.start, task.past, policy.horizon
    if like is not None and np.isfinite(like.states[0]).all():
        begin, steps = like.states[0], like.known_steps
        held = held if like.start_inputs is None else like.start_inputs
    start = Trial(begin[None], nothing, task.dt, *names, start_inputs=held)
    z = np.concatenate([begin, memory_start(model, task.model, start)])
    states, inputs, runner = [begin], np.zeros((steps, model.m)), Runner(policy)
    late, past = task.latency / task.dt, held[:, None]
    for t in range(steps):
        inputs[t] = like.inputs[t] if like else runner.action(t * policy.dt, states[-1])
        sent = inputs[None, : t + 1]
        received = [shifted(sent[..., j], past[j], late[j])[0, -1] for j in range(model.m)]
        z = model.system.step(z[None], np.array([received]), model.values, task.dt)[0]
        if not np.isfinite(z).all():
            return None
        states.append(z[: task.model.n])
    return Trial(np.array(states), inputs, task.dt, *names, start_inputs=held)


def _wrapped(task: Task, h: Hypothesis) -> Model:
    """The model with a hypothesis' shifts and effects in it."""
    model = task.model
    if h.shift is not None:
        moved = model.values + h.shift
        model = model.with_values(dict(zip(model.param_names, moved.tolist(), strict=True)))
    for i in wrapping_order([effect.family for effect in h.effects]):
        effect = h.effects[i]
        current = Library((effect.family,)).effect(effect.name, model, effect.site.scales)
        model = wrap(current, h.values[i], task.dt)
    return model


def _safe(task: Task, run: Trial | None) -> bool:
    if run is None or task.safety_low is None or task.safety_high is None:
        return run is not None
    inside = (run.states >= task.safety_low) & (run.states <= task.safety_high)
    return bool(inside.all())


def _evidence(task: Task, run: Trial, true: Hypothesis, rival: Hypothesis, noise: _Noise) -> float:
    """What the rival, its values free, fails to explain of a run [nats]."""
    data = noise.data(task, [run])
    predictor = Predictor(data)
    rss = []
    for h in (true, rival):
        start = [(h, noise.model, data.y.copy())]
        fits = refine(predictor, start, iterations=ADAPTED, fixed_noise=True)
        rss.append(float(fits[0].rss.sum()) if fits else np.inf)
    return max(0.5 * (rss[1] - rss[0]), 0.0)
