"""Scoring of diagnoses against opened labels, and against an oracle that knows the effects.

The oracle fits only the true effects (values free, noise and parameters as in a diagnosis). A case
counts as detectable if the evidence of the true effects exceeds 3 nats.

If a case has wrong parameters beside its effect, naming these is correct, too: the effect must be
first among the other names, whether the parameters are calibrated together or named one by one.

Other marks are a further name without a true effect (`false_second`), and names that predict worse
than the model without them (`worse`). `summary` gives each share with its count and Wilson's 95 %
interval.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from grounded.challenge import systems
from grounded.diagnosis.hypotheses.search import HypothesisSearch
from grounded.diagnosis.likelihood.data import prepare
from grounded.diagnosis.likelihood.hypothesis import Hypothesis
from grounded.effects import Library
from grounded.frozen import Array
from grounded.model import Model
from grounded.trial import Trial

Marks = Sequence[Mapping[str, Any]]
DETECTABLE = 3.0  # nats
WORSE = 1.01  # ratio of errors from which the named effects predict worse than none
LEAVES = 1.3  # gap from which a false claim misleads
LATE = {"delay": "sensor_delay", "lag": "sensor_lag"}  # findings of the instruments as effects


@dataclass(frozen=True)
class Oracle:
    """Evidence of the true effects over the best hypothesis without them [nats]."""

    evidence: float
    each: Mapping[str, float]  # what the evidence loses without each true effect


def oracle(
    model: Model, trials: Sequence[Trial], latency: Array, label: Mapping[str, Any]
) -> Oracle | None:
    """Fit the true effects of a case; None if the opened label has no effect of the library."""
    if not label["effects"]:
        return None
    data = prepare(model, trials, latency)
    effects = {
        one["effect"]: (Library().effect(one["effect"], model, data.scales), one["params"])
        for one in label["effects"]
    }
    search = HypothesisSearch(data, Library().candidates(model, data.scales))
    search.nulls()

    def fitted(names: Collection[str]) -> float:
        """Return the best score of a set of effects."""
        h = Hypothesis()
        for effect, values in map(effects.__getitem__, names):
            h = h.plus(effect, {q.name: float(values[q.name]) for q in effect.free})
        starts = [(h, f.noise, f.track) for f in (*search.of_size(0), *_plain(search))]
        for start in [*starts, search.fresh(h)]:
            for fit in search.refined([start], 12):
                search.calibrated(fit)
        found = [f for f in search.of_size(len(h.names)) if {*f.hypothesis.names} == {*h.names}]
        return search.score(found[0])

    whole, each = fitted(effects), dict[str, float]()
    for name in effects:
        rest = effects.keys() - {name}
        each[name] = whole - (fitted(rest) if rest else search.score(search.best_null()))
    return Oracle(whole - search.score(search.best_null()), each)


def _plain(search: HypothesisSearch) -> list[Any]:
    """Return the fits without effects under white noise and with exact parameters."""
    return [
        f
        for (structure, spread, names), f in search.fits.items()
        if not names and spread == 0 and structure.tau is None
    ]


def judge(
    label: Mapping[str, Any], diagnosis: Mapping[str, Any], known: Oracle | None
) -> dict[str, Any]:
    """Return the marks of one case."""
    truth = [e["effect"] for e in label["effects"]]
    mended = [f for f in diagnosis.get("preflight", ()) if f["corrected"] and f["kind"] in LATE]
    sensors = [f"{LATE[f['kind']]}:{f['signal']}" for f in mended]  # found before any physics
    off = [f"parameter:{name}" for name in diagnosis["verdict"].get("parameters", ())]
    named = list(dict.fromkeys([*sensors, *diagnosis["verdict"]["effects"], *off]))
    listed = [r["effect"] for r in diagnosis["ranking"]]
    order = sensors + listed if named else []  # without a claim, the ranking names nothing
    if label["param_error"] and _physical(named, label):  # wrong parameters are true names, too
        order = [name for name in order if name in truth or not name.startswith("parameter:")]
    group = set(order[:1])
    for g in diagnosis["indistinguishable"]:
        if order and order[0] in g:
            group |= set(g[:3])
    clear = bool(diagnosis["leftover"]) or (diagnosis["gap"]["after"] or 0.0) <= LEAVES
    marks: dict[str, Any] = {
        "case": label["case"],
        "kind": label["kind"],
        "noise": label["noise"],
        "verdict": diagnosis["verdict"]["kind"],
        "truth": truth or [label.get("withheld", {}).get("name", "none")],
        "named": named,
        "first": bool(truth) and order[:1] == truth[:1],
        "in_group": bool(truth) and truth[0] in group,
        "both": set(truth) <= set(named),
        "both_in_group": _matched(truth, named, diagnosis["indistinguishable"]),
        "leftover": bool(diagnosis["leftover"]),
        "system": label["system"],
        "false_effect": not truth and bool(_physical(named, label)),
        "false_second": bool(truth) and _spare(truth, named, label) > 0,
        "covered": _covered(label, diagnosis),
        "misleading": not truth and bool(_physical(named, label)) and not clear,
        "worse": bool(named) and _ratio(diagnosis, _without(diagnosis)) > WORSE,
    }
    if known is not None:
        marks["evidence"] = known.evidence
        marks["detectable"] = known.evidence > DETECTABLE
        marks["each_detectable"] = all(v > DETECTABLE for v in known.each.values())
    return marks


def of_crude(label: Mapping[str, Any], model: Model) -> dict[str, Any]:
    """Return a label whose parameter shifts are relative to the crude model, as in a diagnosis.

    A drawn shift is relative to the system's own value, which the crude model may not have.
    """
    true = systems.SYSTEMS[label["system"]].model if label["param_error"] else model
    effects = []
    for entry in label["effects"]:
        name = entry["effect"].removeprefix("parameter:")
        if name != entry["effect"]:
            apart = float(true.params[name].value) - float(model.params[name].value)
            entry = {**entry, "params": {"d": entry["params"]["d"] + apart}}
        effects.append(entry)
    return {**label, "effects": effects}


def _physical(named: Sequence[str], label: Mapping[str, Any]) -> list[str]:
    """Return the names, without parameters if those are off in the case."""
    return [n for n in named if not (label["param_error"] and n.startswith("parameter:"))]


def _spare(truth: Sequence[str], named: Sequence[str], label: Mapping[str, Any]) -> int:
    """Return the number of names in excess of the true effects."""
    return len(set(_physical(named, label)) | (set(truth) & set(named))) - len(truth)


def _matched(truth: Sequence[str], named: Sequence[str], ties: Sequence[Sequence[str]]) -> bool:
    """Check that each true effect is named, or tied with a name of its own."""
    free = [name for name in named if name not in truth]
    for effect in (effect for effect in truth if effect not in named):
        place = next((g[0] for g in ties if effect in g[:3] and g[0] in free), None)
        if place is None:
            return False
        free.remove(place)
    return True


def _row(diagnosis: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the row of prediction errors at the longest horizon but the whole trial."""
    rows = [row for row in diagnosis.get("prediction_error", ()) if not row["whole_trial"]]
    return rows[-1] if rows else {}


def _without(diagnosis: Mapping[str, Any]) -> Mapping[str, float]:
    """Return the errors without the named effects: calibrated ones, unless only parameters are."""
    row, named = _row(diagnosis), diagnosis["verdict"]["effects"]
    effects = any(not name.startswith("parameter:") for name in named)
    return dict((effects and row.get("calibrated")) or row.get("crude", {}))


def _ratio(diagnosis: Mapping[str, Any], other: Mapping[str, float]) -> float:
    """Return the ratio of a diagnosis' held-out errors to others, geometric mean of channels."""
    own = _row(diagnosis).get("with_effects", {})
    pairs = [(own[n], other[n]) for n in own if n in other]
    logs = [np.log(a / b) for a, b in pairs if a is not None and b is not None and a > 0 and b > 0]
    return float(np.exp(np.mean(logs))) if logs else float("nan")


def _covered(label: Mapping[str, Any], diagnosis: Mapping[str, Any]) -> list[bool]:
    """Return whether each interval of a value of a claimed true effect holds the true one."""
    rows = {r["effect"]: r["params"] for r in diagnosis["ranking"] if r["claimed"]}
    found = []
    for entry in label["effects"]:
        for name, estimate in rows.get(entry["effect"], {}).items():
            if (interval := estimate.get("interval")) is not None:  # its std may be unknown
                found.append(bool(interval[0] <= float(entry["params"][name]) <= interval[1]))
    return found


SHARES = {  # of the cases of a kind: figure -> (mark, the mark of the cases that count, "" for all)
    "single": {
        "first": ("first", "detectable"),
        "in_group": ("in_group", "detectable"),
        "false_second": ("false_second", ""),
    },
    "double": {
        "both": ("both", "each_detectable"),
        "both_in_group": ("both_in_group", "each_detectable"),
        "false_second": ("false_second", ""),
    },
    "none": {"leftover": ("leftover", "")},
    "withheld": {
        "misleading": ("misleading", ""),
        "claimed": ("false_effect", ""),
        "leftover": ("leftover", ""),
    },
}


def summary(marks: Marks) -> dict[str, Any]:
    """Return summary figures of a set of marked cases, by kind."""
    found: dict[str, Any] = {}
    for kind in sorted({m["kind"] for m in marks}):
        some = [m for m in marks if m["kind"] == kind]
        verdicts = dict.fromkeys(("effect", "several", "none", "unknown"), 0)
        verdicts |= Counter(m["verdict"] for m in some)
        row: dict[str, Any] = {"cases": len(some), "verdicts": verdicts}
        row["worse"] = share(m["worse"] for m in some)
        if kind == "none":
            by = {
                n: [m for m in some if m["noise"] == n] for n in sorted({m["noise"] for m in some})
            }
            row["false"] = {n: share(m["false_effect"] for m in own) for n, own in by.items()}
        for name, (mark, only) in SHARES[kind].items():
            row[name] = share(m[mark] for m in some if not only or m.get(only))
        if kind in ("single", "double"):  # intervals that hold
            row["coverage"] = share(c for m in some for c in m["covered"])
        found[kind] = row
    return found


def share(said: Iterable[bool]) -> dict[str, Any]:
    """Return count, total, share and its 95 % interval (Wilson 1927)."""
    each = list(said)
    n, k, z = len(each), sum(each), 1.96
    if not n:
        return {"count": 0, "of": 0, "share": None, "interval": None}
    middle = (k + z**2 / 2) / (n + z**2)
    half = z / (n + z**2) * float(np.sqrt(k * (n - k) / n + z**2 / 4))
    interval = [max(middle - half, 0.0), min(middle + half, 1.0)]
    return {"count": k, "of": n, "share": k / n, "interval": interval}
