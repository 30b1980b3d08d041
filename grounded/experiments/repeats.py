"""The line search with noisy trials: the cost of comparing single trials, and rules that help.

Rules are compared at four levels of scatter, multiples of the simulated car's own
(`real_car.SCATTER`), by the TRUE utility, the mean of fresh runs, of each policy that a rule
accepts:

    false      accepted steps that made the policy truly worse
    closed     share of the gap between the model's policy and the optimum that the final one closes
    early      the same after EARLY trials, for smaller budgets than BUDGET
    flattered  measured utility of the winner minus its true utility, relative to the gap

A rule runs a candidate `repeats` times and averages states, inputs and utilities; the bias is that
of the mean. "incumbent again" reruns the best policy with every candidate, so that a lucky
measurement is averaged out; "losses checked" does so only after a loss that may be due to chance
([search] rerun_incumbent).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Unpack

import numpy as np

from grounded.experiments.bench import bench, optimum, scaled, searched, true_utility
from grounded.experiments.jobs import Running, StudyTable, every, mean_se, run_study
from grounded.frozen import Array
from grounded.policy import Policy
from grounded.search.step.step_size import SearchOptions

LEVELS = (0.5, 1.0, 2.0, 3.0)
MANOEUVRES = ("turn", "figure8")
BUDGET = 40  # trials
EARLY = 10  # trials
FRESH = 30  # runs that judge a policy


@dataclass(frozen=True)
class LineSearchRule:
    """A rule for accepting candidates by their trials."""

    name: str
    repeats: int
    max_halvings: int
    again: bool = False  # the incumbent is rerun with every candidate
    checked: bool = False  # ... only after a loss that may be due to chance


RULES = (
    LineSearchRule("single trials, alpha to 1/64", 1, 6),
    LineSearchRule("single trials, alpha to 1/8", 1, 3),
    LineSearchRule("single trials, incumbent again", 1, 3, again=True),
    LineSearchRule("losses checked, alpha to 1/64", 1, 6, checked=True),
    LineSearchRule("losses checked, alpha to 1/8", 1, 3, checked=True),
    LineSearchRule("2 trials, alpha to 1/8", 2, 3),
    LineSearchRule("3 trials, alpha to 1/8", 3, 3),
)


@dataclass(frozen=True)
class Outcome:
    """The result of one rule on one case."""

    rule: str
    manoeuvre: str
    level: float
    seed: int
    accepted: int  # steps
    false: int
    closed: float
    early: float
    flattered: float
    trials: int


@dataclass(frozen=True)
class NoiseResult:
    """All outcomes, in the order of manoeuvre, level, rule, seed."""

    outcomes: tuple[Outcome, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the outcomes as plain values, and the recommended rule."""
        return {"outcomes": [vars(o) for o in self.outcomes], "recommended": self.recommended}

    @property
    def recommended(self) -> str:
        """The rule with the fewest trials that closes as much as the best, within a standard error.

        Shares are compared pairwise by case and seed.
        """
        closed = {rule: self._over_cases(rule, "closed") for rule in self._rules}
        best = closed[max(closed, key=lambda rule: float(closed[rule].mean()))]

        def as_good(rule: str) -> bool:
            short, error = mean_se((best - closed[rule]).tolist())
            return short <= (error if np.isfinite(error) else 0.0)

        good = [rule for rule in self._rules if as_good(rule)]
        return min(good, key=lambda rule: float(self._over_cases(rule, "trials").mean()))

    @property
    def _rules(self) -> list[str]:
        return list(dict.fromkeys(o.rule for o in self.outcomes))

    def _over_cases(self, rule: str, what: str) -> Array:
        """Return one figure per case and seed, in the same order for every rule."""
        own = sorted(
            (o.manoeuvre, o.level, o.seed, getattr(o, what))
            for o in self.outcomes
            if o.rule == rule
        )
        return np.array([values[-1] for values in own])

    def _summary(self) -> StudyTable:
        rows, recommended = [], self.recommended
        for rule in self._rules:
            closed, early, trials = (
                self._over_cases(rule, k) for k in ("closed", "early", "trials")
            )
            mean, error = mean_se(closed.tolist())
            mark = "* " if rule == recommended else "  "
            rows.append(
                (
                    mark + rule,
                    f"{mean:.1%} (±{error:.1%})",
                    f"{closed.min():.1%}",
                    f"{early.mean():.1%}",
                    f"{trials.mean():.1f}",
                )
            )
        head = ("rule (*: recommended)", "gap closed", "worst", f"after {EARLY}", "trials")
        return StudyTable("all cases: means", head, tuple(rows))

    def _of(self, rule: str, manoeuvre: str, level: float) -> list[Outcome]:
        wanted = (rule, manoeuvre, level)
        return [o for o in self.outcomes if (o.rule, o.manoeuvre, o.level) == wanted]

    def tables(self) -> list[StudyTable]:
        """Return tables by manoeuvre and level, then one of all cases."""
        cases = dict.fromkeys((o.manoeuvre, o.level) for o in self.outcomes)
        each = [self._table(manoeuvre, level) for manoeuvre, level in cases]
        return [*each, self._summary()]

    def _table(self, manoeuvre: str, level: float) -> StudyTable:
        rows = []
        for rule in self._rules:
            own = self._of(rule, manoeuvre, level)
            if not own:
                continue
            steps, false = sum(o.accepted for o in own), sum(o.false for o in own)
            closed = [o.closed for o in own]
            rows.append(
                (
                    rule,
                    f"{false} of {steps}",
                    f"{np.median(closed):.1%}",
                    f"{min(closed):.1%}",
                    f"{np.median([o.early for o in own]):.1%}",
                    f"{np.median([o.flattered for o in own]):.1%}",
                    f"{np.median([o.trials for o in own]):g}",
                )
            )
        after = f"after {EARLY}"
        head = ("rule", "false acceptances", "gap closed", "worst", after, "flattered by", "trials")
        return StudyTable(f"{manoeuvre}, scatter x{level:g}", head, tuple(rows))


def run(
    seeds: Sequence[int] = range(8),
    *,
    manoeuvres: Sequence[str] = MANOEUVRES,
    levels: Sequence[float] = LEVELS,
    rules: Sequence[LineSearchRule] = RULES,
    **how: Unpack[Running],
) -> NoiseResult:
    """Run every rule on every case, one job each."""
    cases = every(manoeuvre=manoeuvres, level=levels, rule=map(vars, rules), seed=seeds)
    return NoiseResult(run_study(Outcome, repeats_job, cases, **how))


def repeats_job(rule: dict[str, Any], manoeuvre: str, level: float, seed: int) -> dict[str, Any]:
    """Run one job: one rule on one case."""
    how = LineSearchRule(**rule)
    case = bench(manoeuvre, "noise", seed)
    best, _ = optimum(case)
    case = replace(case, plant=scaled(case.plant, level))

    def truly(policy: Policy) -> float:
        return true_utility(case.task, case.plant, policy, FRESH, seed)

    options = SearchOptions(
        max_trials=BUDGET,
        repeats=how.repeats,
        max_halvings=how.max_halvings,
        rerun_incumbent=how.checked,
    )
    accepted, claimed, trials = searched(case, options, again=how.again)
    utilities = [truly(kept.policy) for kept in accepted]
    early = [u for kept, u in zip(accepted, utilities, strict=True) if kept.trials <= EARLY][-1]
    gap = truly(best) - utilities[0]
    return {
        "rule": how.name,
        "manoeuvre": manoeuvre,
        "level": level,
        "seed": seed,
        "accepted": len(accepted) - 1,
        "false": int((np.diff(utilities) < 0).sum()),
        "closed": (utilities[-1] - utilities[0]) / gap,
        "early": (early - utilities[0]) / gap,
        "flattered": (claimed - utilities[-1]) / gap,
        "trials": trials,
    }
