"""Compare the diagnosis with other methods for a model's error, on blind challenge cases.

    python benchmarks/peer_diagnosis.py --cases 30 --seed S [--systems own,kinked,mujoco] [--json F]

All methods get the same trials and the same crude model, and are judged on two further trials: rms
error 1 s ahead, open loop, the geometric mean over channels, divided by that of the crude model
with the true effects at their true values (the oracle). The peers are helped: they regress the
crude model's residual over five steps on features, and each true law is close to one of these.

grounded    the diagnosis
pysindy     STLSQ of PySINDy, its threshold chosen on held-out trials
parameters  the model's parameters alone, by maximum likelihood (`grounded.fit`)

Needs the extra `peers`; missing libraries are skipped with a note. A name is "first" if it is the
true effect, of the "same kind" if it acts alike at the same place, else "wrong".
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from helpers import table

from grounded.challenge import make, task_of
from grounded.diagnosis.diagnose import diagnose
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.effects import Library
from grounded.fit import fit

AHEAD, EVERY, PIECE = 1.0, 10, 5  # [s]; steps between starts; steps of a piece that is regressed
THRESHOLDS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # of STLSQ, features and targets scaled to one
LATE = ("delay", "first_order_lag", "rate_limit", "backlash", "slew_limit")
STRAIGHT = ("input_gain", "input_curve", "input_fade", "saturation")
STEADY = ("offset", "input_bias", "drift_world", "drift_body", "slope", "trend", "sensor_bias")
DRY = ("coulomb_friction", "joint_friction", "load_friction", "stiction", "stall", "dead_zone")
DRAG = ("viscous_friction", "quadratic_drag", "joint_friction", "cornering_drag")
KINDS = {"1": STEADY, "u": STRAIGHT, "late": LATE, "sign": DRY, "square": DRAG, "x": DRAG}
KINDS["own"] = ("rate_gain", "added_inertia", *STRAIGHT)


class Log:
    """Trials of a case as arrays: y (S, T + 1, n), received u and the change of it (S, T, m)."""

    def __init__(self, case, trials):
        self.data = prepare(case.model, trials, case.latency)
        self.predictor = Predictor(self.data)
        self.y = np.stack([trial.states for trial in trials])
        self.u = self.predictor.received(Hypothesis())[:, : self.y.shape[1] - 1]
        self.change = np.diff(self.u, axis=1, prepend=self.u[:, :1])

    def step(self, x, u):
        return self.predictor.moved(Hypothesis(), x, u)


def features(log, x, u, change):
    """Return features (..., k) and their names: (kind, index)."""
    names, columns = [("1", 0)], [np.ones(x.shape[:-1])]
    own = (log.step(x, u) - x) / log.data.dt
    size = np.maximum(np.abs(log.y).reshape(-1, x.shape[-1]).max(axis=0), 1e-9)
    for i in range(x.shape[-1]):
        s = x[..., i] / size[i]
        names += [("x", i), ("sign", i), ("square", i), ("own", i)]
        columns += [s, np.tanh(s / 0.02), s * np.abs(s), own[..., i]]
    for j in range(u.shape[-1]):
        names += [("u", j), ("late", j)]
        columns += [u[..., j], change[..., j]]
    return np.stack(columns, axis=-1), names


def regression(log):
    """Return features and missing rates of pieces: (S, P, k), (S, P, n), names."""
    T = log.u.shape[1]
    at = np.arange(0, T - PIECE, PIECE)
    x, total = log.y[:, at], 0.0
    for k in range(PIECE):
        one, names = features(log, x, log.u[:, at + k], log.change[:, at + k])
        total, x = total + one / PIECE, log.step(x, log.u[:, at + k])
    left = log.data.model.difference(log.y[:, at + PIECE], x) / (PIECE * log.data.dt)
    return total, left, names


def errors(log, advance, offset=lambda x: 0.0, received=None):
    """Return the rms error AHEAD seconds ahead by channel (n,)."""
    u = log.u if received is None else received[:, : log.u.shape[1]]
    steps = max(1, round(AHEAD / log.data.dt))
    at = np.arange(0, log.u.shape[1] - steps, EVERY)
    x = log.y[:, at] - offset(log.y[:, at])
    for k in range(steps):
        x = advance(x, u[:, at + k], log.change[:, at + k], (at + k) * log.data.dt + 0 * x[..., 0])
        x = np.clip(np.nan_to_num(x, nan=1e6), -1e6, 1e6)
    miss = log.data.model.difference(log.y[:, at + steps], x + offset(x))
    return np.sqrt((miss**2).mean(axis=(0, 1)))


def hypothesis_errors(case, pairs, parameters):
    """Return errors of the crude model with effects (name, values) and other parameters."""
    known = case.model.with_values(parameters)
    log = Log(case, case.fresh)
    inside = Log(type("Other", (), {"model": known, "latency": case.latency}), case.fresh)
    h = Hypothesis()
    for name, values in pairs:
        if name.startswith("parameter:"):
            continue
        effect = Library().effect(name, known, log.data.scales)
        h = h.plus(effect, {q.name: values[q.name] for q in effect.quantities if q.name in values})
    p = inside.predictor
    return errors(
        log, lambda x, u, c, t: p.advance(h, x, u, t), lambda x: p.standing(h, x), p.received(h)
    )


def by_grounded(case, log):
    found = diagnose(task_of(case), case.trials).to_json()
    rows = [r for r in found["ranking"] if r["claimed"]]
    late = [f for f in found.get("preflight", ()) if f["kind"] == "delay" and f["corrected"]]
    named = [f"sensor_delay:{f['signal']}" for f in late] + [r["effect"] for r in rows]
    pairs = [
        (r["effect"], {k: e["value"] for k, e in r["params"].items()} | r["fixed"]) for r in rows
    ]
    values = {name: e["value"] for name, e in found["parameters"].items()}
    return named[:1], hypothesis_errors(case, pairs, values)


def by_parameters(case, log):
    found = fit(task_of(case), case.trials)
    moved = {
        name: abs(v.value - v.start) / v.std
        for name, v in found.params.items()
        if v.identified and v.std > 0
    }
    top = max(moved, key=moved.get, default=None)
    named = [f"parameter:{top}"] if top and moved[top] > 3 else []
    return named, hypothesis_errors(case, [], {n: v.value for n, v in found.params.items()})


def linear(case, log, solve):
    """Fit a sparse regression: solve(features (S, P, k), target (S, P)) -> coefficients (k,)."""
    F, R, names = regression(log)
    size = np.maximum(F.std(axis=(0, 1)), 1e-9)
    size[0], scale = 1.0, np.maximum(R.std(axis=(0, 1)), 1e-12)
    found = np.stack(
        [solve(F / size, R[..., i] / scale[i]) for i in range(R.shape[-1])]
    )  # (n, k), in units of the targets
    term = np.unravel_index(np.abs(found).argmax(), found.shape)
    named = [(term[0], *names[term[1]])] if found[term] else []
    C = found * scale[:, None] / size
    fresh = Log(case, case.fresh)

    def advance(x, u, change, t):
        F, _ = features(log, x, u, change)
        return fresh.step(x, u) + log.data.dt * F @ C.T

    return named, errors(fresh, advance)


def by_pysindy(case, log):
    from pysindy import STLSQ

    def fitted(F, r, threshold):
        model = STLSQ(threshold=threshold, alpha=1e-3)
        return np.asarray(model.fit(F, r[:, None]).coef_).reshape(-1)

    def solve(F, r):
        k, S = F.shape[-1], len(F)

        def missed(threshold):
            total = 0.0
            for s in range(S):
                rest = np.arange(S) != s
                c = fitted(F[rest].reshape(-1, k), r[rest].reshape(-1), threshold)
                total += ((F[s] @ c - r[s]) ** 2).sum()
            return total

        scores = {threshold: missed(threshold) for threshold in THRESHOLDS}
        best = min(scores, key=scores.get)
        if scores[best] >= (r**2).sum():
            return np.zeros(k)
        return fitted(F.reshape(-1, k), r.reshape(-1), best)

    return linear(case, log, solve)


METHODS = {
    "grounded": by_grounded,
    "pysindy": by_pysindy,
    "parameters": by_parameters,
}


def marked(case, named):
    """Return how a first name compares with the truth."""
    truth = case.label["effects"][0]["effect"]
    family, _, target = truth.partition(":")
    if not named:
        return "nothing"
    if isinstance(named[0], str):
        same = named[0].partition(":")[0] == family
        return "first" if named[0] == truth else "same kind" if same else "wrong"
    i, kind, j = named[0]
    state, source = case.model.state_names[i], case.model.state_names[j % case.model.n]
    if kind in ("u", "late"):
        source = case.model.input_names[j]
    exact = {
        "1": f"offset:{state}",
        "u": f"input_gain:{source}",
        "late": f"delay:{source}",
        "sign": f"coulomb_friction:{state}" if i == j else "",
        "square": f"quadratic_drag:{state}" if i == j else "",
        "own": f"rate_gain:{state}" if i == j else "",
        "x": f"viscous_friction:{state}" if i == j else f"coupling:{state}<-{source}",
    }[kind]
    there = {state} if kind == "1" else {source}
    places = set(target.replace("<-", "+").split("+"))
    if exact == truth or (kind == "late" and family in LATE[:2] and source == target):
        return "first"
    return "same kind" if family in KINDS[kind] and (places & there or kind == "1") else "wrong"


def measured(case, methods):
    """Measure one case: by method the mark, the error over the oracle's, CPU seconds."""
    log, row = Log(case, case.trials), {}
    truth = case.label["effects"]
    shift = {
        e["effect"].partition(":")[2]: e["params"]["d"]
        for e in truth
        if "parameter:" in e["effect"]
    }
    exact = {n: p.value + shift.get(n, 0.0) for n, p in case.model.params.items()}
    best = hypothesis_errors(case, [(e["effect"], e["params"]) for e in truth], exact)
    crude = hypothesis_errors(case, [], {})
    over = lambda e: float(np.exp(np.log(np.maximum(e, 1e-12) / np.maximum(best, 1e-12)).mean()))  # noqa: E731
    row["crude"] = {"mark": "", "over_oracle": over(crude)}
    for name in methods:
        begin = time.process_time()
        try:
            named, missed = METHODS[name](case, log)
        except ImportError as error:
            print(f"{name}: left out, {error}", file=sys.stderr)
            continue
        seconds = time.process_time() - begin
        row[name] = {"mark": marked(case, named), "over_oracle": over(missed), "cpu_s": seconds}
    return row


def results(rows):
    """Return the rows as a Markdown table."""
    head = ["method", "first", "same kind", "wrong", "nothing"]
    head += ["error over the oracle's, median", "CPU s"]
    lines = []
    for name in dict.fromkeys(n for row in rows for n in row):
        some = [row[name] for row in rows if name in row]
        marks = Counter(one["mark"] for one in some)
        median = np.median([one["over_oracle"] for one in some])
        seconds = np.mean([one.get("cpu_s", 0.0) for one in some])
        counts = [marks[k] for k in ("first", "same kind", "wrong", "nothing")]
        lines.append([name, *counts, f"{median:.3f}", f"{seconds:.1f}"])
    return table(head, lines)


def main():
    """Make the cases, run all methods, print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, default=30)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--systems", default="own,kinked,mujoco")
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--json", type=Path)
    asked, rows = parser.parse_args(), []
    warnings.simplefilter("ignore")
    cases = make("single", asked.cases, asked.seed, groups=asked.systems.split(","), param_error=0)
    for case in cases:
        row = measured(case, asked.methods.split(","))
        rows.append(row)
        told = ", ".join(f"{n} {v['mark']} {v['over_oracle']:.2f}" for n, v in row.items())
        print(f"{case.name} {case.label['effects'][0]['effect']}: {told}", file=sys.stderr)
        if asked.json:
            asked.json.write_text(json.dumps(rows, indent=1))
    print(results(rows))


if __name__ == "__main__":
    main()
