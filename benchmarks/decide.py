"""The decision of a diagnosis on blind cases: fitted once, decided in seconds.

    python -m benchmarks.decide make FOLDER --kind single --cases 48 --seed 911290001
    python -m benchmarks.decide FOLDER [--half open|sealed|all] [--curves]

`make` diagnoses cases of the challenge and keeps of each what the rule (`grounded.diagnosis.
validation.choose`) decides on: every set of causes that was fitted, with evidence, held-out errors
and guards, the document, its label and the oracle's. Without `make`, the rule is applied to all of
them again: names found, false and spurious ones with Wilson's intervals, what the rule now names
otherwise, and with --curves the same as each of its numbers changes. The halves are by seed: look
at the open one, and open the sealed one once.
"""

from __future__ import annotations

import argparse
import pickle
from pathlib import Path

import grounded.diagnosis.diagnose as diagnosing
from grounded.challenge import KINDS, judge, make, of_crude, oracle
from grounded.challenge.score import share
from grounded.diagnosis.validation import choose
from grounded.diagnosis.validation.decide import Options, decide

CURVES = {
    (choose, "PICKED"): (1.0, 3.0, 5.0, 8.0, 12.0),
    (choose, "ERRORS"): (0.0, 0.5, 1.0, 1.5, 2.0, 3.0),
    (choose, "SHARE"): (0.0, 0.01, 0.02, 0.05),
    (choose, "LEAST"): (0.0, 0.01, 0.03, 0.1),
}


def fitted(case):
    """Diagnose a case; return what its decision rests on, with the label and the marks."""
    kept = {}

    def watched(search, ruler):
        kept.update(search=search, ruler=ruler)
        return decide(search, ruler)

    diagnosing.decide = watched
    try:
        document = diagnosing.diagnose(case.task, case.trials).to_json()
    finally:
        diagnosing.decide = decide
    options = Options(kept["search"], kept["ruler"])
    known = {one.causes: one for one in options.hopeful()}
    less = {
        (one.causes, cause): rest
        for one in known.values()
        for cause in one.causes
        if (rest := options.less(one, cause)) is not None
    }
    pairs = [(rest, known[own]) for (own, _), rest in less.items()]
    nats = {(a.causes, b.causes): options.nats(a, b) for a, b in pairs}
    none = known[frozenset()]
    alone = {one.causes: options.nats(none, one) for one in [*known.values(), *less.values()]}
    label = of_crude(case.label, case.task.model)
    true = oracle(case.task.model, case.trials, case.task.latency, label)
    ruler = kept["ruler"]
    return {
        "options": list(known.values()), "less": less, "nats": nats, "alone": alone,
        "compare": ruler.comparison, "held_out": ruler.held_out, "label": label, "oracle": true,
        "document": document, "marks": judge(label, document, true),
    }  # fmt: skip


def decided(case):
    """Return the names that the rule gives now."""
    memory = {}

    def gain(before, after):
        key = id(before), id(after)
        if key not in memory:
            memory[key] = case["compare"](before, after)
        return memory[key]

    def less(option, cause):
        return case["less"].get((option.causes, cause))

    def nats(before, after):
        apart = case["alone"][after.causes] - case["alone"][before.causes]
        return case["nats"].get((before.causes, after.causes), apart)

    rule = choose.Rule(case["options"], gain, nats, less, held_out=case["held_out"])
    return rule.choose().chosen.causes - {"calibration"}


def marked(case, names):
    """Return the marks of a diagnosis that names these effects."""
    verdict = case["document"]["verdict"] | {"effects": sorted(names), "parameters": []}
    return judge(case["label"], case["document"] | {"verdict": verdict}, case["oracle"])


def told(marks):
    """Return the figures of some marks in a line."""
    clear = [m for m in marks if m.get("each_detectable")]
    rows = [(kind, [m["both"] for m in clear if m["kind"] == kind]) for kind in KINDS[:2]]
    rows.append(("spurious", [m["false_second"] for m in marks if m["kind"] in KINDS[:2]]))
    for kind in KINDS[2:]:
        rows.append((f"named in {kind}", [m["false_effect"] for m in marks if m["kind"] == kind]))
    words = []
    for name, each in rows:
        found = share(each)
        if found["of"]:
            low, high = (100 * end for end in found["interval"])
            words.append(f"{name} {found['count']} of {found['of']} ({low:.0f} to {high:.0f} %)")
    return ", ".join(words)


def main():
    """Make cases, or decide them again."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("words", nargs="+", metavar="[make] FOLDER")
    parser.add_argument("--kind", choices=KINDS, default="single")
    parser.add_argument("--cases", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--systems", default="own,kinked,mujoco")
    parser.add_argument("--half", choices=("open", "sealed", "all"), default="open")
    parser.add_argument("--curves", action="store_true")
    options = parser.parse_args()
    folder = Path(options.words[-1])
    if options.words[0] == "make":
        folder.mkdir(parents=True, exist_ok=True)
        for case in make(
            options.kind, options.cases, options.seed, groups=options.systems.split(",")
        ):
            path = folder / f"{options.seed}-{case.name}.pkl"
            if not path.exists():
                path.write_bytes(pickle.dumps(fitted(case)))
                print(path.name, flush=True)
        return
    halves = {"open": (1,), "sealed": (0,), "all": (0, 1)}[options.half]
    paths = [p for p in sorted(folder.glob("*.pkl")) if int(p.name.split("-")[0]) % 2 in halves]
    cases = {path.stem: pickle.loads(path.read_bytes()) for path in paths}
    for name, case in cases.items():
        then = set(case["document"]["verdict"]["effects"])
        now = decided(case)
        if now != then:
            truth = [e["effect"] for e in case["label"]["effects"]]
            print(f"{name}: truth {truth}; when made {sorted(then)}; now {sorted(now)}")
    then = [marked(c, c["document"]["verdict"]["effects"]) for c in cases.values()]
    print(f"{len(cases)} cases\nwhen made: {told(then)}")
    print("now:       " + told([marked(case, decided(case)) for case in cases.values()]))
    for (room, name), values in CURVES.items() if options.curves else ():
        usual = getattr(room, name)
        for value in values:
            setattr(room, name, value)
            line = told([marked(case, decided(case)) for case in cases.values()])
            print(f"{name} {value:g}{' *' if value == usual else ''}: {line}")
        setattr(room, name, usual)


if __name__ == "__main__":
    main()
