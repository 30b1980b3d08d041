"""A candidate: a policy to run and how it came about; and what became of it, with its trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.result import Result, document
from grounded.trial import Trial

Way = Literal[
    "",  # a step along the direction of the model that replays the incumbent's trial
    "recorded inputs",  # the same, the bias as the paper has it (`bias`: no matched inputs)
    "gentler gains",  # the incumbent's plan with gains designed more gently (`Maker.gentler`)
    "own plan",  # of a model that was changed since the incumbent was planned (`About.own_plan`)
]

Slopes = Literal[
    "",  # the model's own
    "corrected",  # by what earlier trials were mispredicted by, see `mispredictions`
]

LITTLE = 0.1  # of the best one's cost: a doubtful promise below it is no reason to go on
UNLIKE = 0.2  # of a promised gain: how much luckier a trial is than the model says, to be told

if TYPE_CHECKING:
    from grounded.figures.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Candidate(Result):
    """A policy to run, and how it came about."""

    id: str  # c0001, c0002 ...: the order of proposal
    policy: Policy
    iteration: int  # i of theta^(i) that it tries to be; 0 is the model's own policy
    alpha: float
    base: str  # the candidate whose trials it was derived from, "" for the model's own
    model: str  # fingerprint of the model it was planned in
    predicted_states: Array  # (H + 1, n) in the (biased) model
    predicted_inputs: Array  # (H, m)
    predicted_utility: float
    damping: float = 1.0  # lambda of `step_size`
    predicted_gain: float = float("nan")  # over the mean trial of its base
    caution: float = 0  # how often the first policy, or its gains, were designed more gently
    way: Way = ""  # how it was made
    slopes: Slopes = ""  # of the model that it was planned in
    base_as_run: float = float("nan")  # what the model gives its base from where its trials began
    likely_off: float = 0.0  # of predicted_gain, as trials that were left out say; 0: not known

    @property
    def predicted_run(self) -> Trial:
        """What the model predicts, as a robot would log it."""
        made = self.policy
        names = (made.state_names, made.input_names)
        return Trial(
            self.predicted_states, self.predicted_inputs, made.dt, *names, start_inputs=made.past
        )

    @property
    def grounded(self) -> bool:
        """Whether a model that replays a trial has predicted it: a step along a direction."""
        return bool(self.base) and self.way in ("", "recorded inputs")

    @property
    def expected_gain(self) -> float:
        """The promised gain less what the model is likely to miss of it."""
        return self.predicted_gain - self.likely_off

    @property
    def doubtful(self) -> bool:
        """Whether its model is likely to be off by more than it promises."""
        return 0 < self.likely_off >= self.predicted_gain

    @property
    def expected_of_base(self) -> float:
        """What the same model gives the candidate that the step started from.

        Noise and a start that was off make a trial luckier or less so; the gain leaves them out.
        """
        return self.predicted_utility - self.predicted_gain

    def unlike(self, utility: float) -> bool:
        """Whether the model gives its base clearly something else than it was worth in truth."""
        return abs(self.expected_of_base - utility) > UNLIKE * abs(self.predicted_gain)

    def promised_over(self, best: Tried) -> float:
        """What it promises over the best so far: one number for all who tell it.

        By the model alone where that gives its base clearly something else than the runs were
        worth, unless it promises more than can be had: no utility is above 0.
        """
        own = best.candidate.id == self.base and self.predicted_gain <= -best.utility
        if own and self.unlike(best.utility):
            return self.predicted_gain
        return self.predicted_utility - best.utility

    def doubt(self, best: Tried | None) -> str:
        """Why one that is `doubtful` may well lose, a sentence."""
        gain = self.predicted_gain if best is None else self.promised_over(best)
        over = self.base if best is None else best.candidate.id
        cost = self.predicted_gain - self.predicted_utility  # of its base
        off = f"{self.likely_off:.3g}"  # a model that is off by more than that knows no size
        off = f"more than all that {self.base} costs" if self.likely_off > cost > 0 else off
        stop = ""
        if best and self.predicted_gain < LITTLE * abs(best.utility):
            stop = f". You may stop here, with {best.candidate.id}, the best so far"
        return (
            f"{self.id} may well lose: it promises {gain:.3g} over {over}, and its model is likely "
            f"to be off by {off} there, as it was for earlier trials{stop}"
        )

    def summary(self) -> str:
        """Its name, its step and what the model predicts."""
        predicted = f"predicted utility {self.predicted_utility:.4g}"
        return f"{self.id}: iteration {self.iteration}, alpha {self.alpha:g}, {predicted}"

    def to_json(self) -> dict[str, Any]:
        """How it came about; its policy is what `grounded export` writes."""
        return document(
            candidate=self.id,
            iteration=self.iteration,
            alpha=self.alpha,
            damping=self.damping if self.base else None,
            base=self.base or None,
            predicted_utility=self.predicted_utility,
        )

    def figures(self) -> Sequence[Figure]:
        """What the model predicts."""
        from grounded.search.pictures import candidate_figure

        return (candidate_figure(self),)


@dataclass(frozen=True, eq=False, repr=False)
class Tried(Result):
    """A candidate with its trials: mean utility and, once repeats tell, its standard error."""

    candidate: Candidate
    trials: tuple[Trial, ...]
    utilities: tuple[float, ...]
    accepted: bool | None  # None: not decided, trials are missing
    in_doubt: bool = False  # its own trials are there: the incumbent's are missing
    pieces: Array | None = None  # (runs, PIECES) of its utilities, see `scatter`; if repeated
    noise_cost: float = 0.0  # of sensors, in its logs; of the best, and where `promised` needs it
    deviation: float = float("nan")  # of a single run, as repeats near it tell (`scatter`)

    @cached_property
    def utility(self) -> float:
        """Mean utility of the trials; nan without a trial, -inf when one of them failed."""
        return float(np.mean(self.utilities)) if self.utilities else float("nan")

    @property
    def promised(self) -> float:
        """The predicted utility of its logs: with sensors' noise, which a replayed trial has."""
        noise = 0.0 if self.candidate.grounded else self.noise_cost
        return self.candidate.predicted_utility - noise

    @cached_property
    def standard_error(self) -> float:
        """Of the mean; nan where nothing near it was repeated, or where one of its runs failed."""
        if not self.utilities or not np.isfinite(self.utilities).all():
            return float("nan")
        return float(self.deviation / np.sqrt(len(self.utilities)))

    @property
    def failed(self) -> tuple[str, ...]:
        """The names of its trials that did not run to the end."""
        each = zip(self.trials, self.utilities, strict=True)
        return tuple(trial.id for trial, utility in each if utility == -np.inf)

    def verdict(self, last: bool = True) -> str:
        """What became of the candidate: first, better, no better, crashed; or why not decided.

        Args:
            last: whether it is the latest one; an earlier one without a trial will get none.
        """
        if self.in_doubt:
            return "in doubt"
        if self.accepted is None:
            return "waiting" if last or self.trials else "no trial"
        if not self.accepted:
            return "crashed" if self.utility == -np.inf else "no better"
        return "better" if self.candidate.base else "first"

    def summary(self) -> str:
        """Its name, its utility and what became of it."""
        mean = f"utility {self.utility:.4g}, trials {len(self.trials)}"
        return f"{self.candidate.id}: {mean}, {self.verdict()}"

    def to_json(self) -> dict[str, Any]:
        """The candidate's document, and what its trials were worth."""
        return self.candidate.to_json() | document(
            utility=self.utility,
            standard_error=self.standard_error,
            noise_cost=self.noise_cost,
            trials=[trial.id for trial in self.trials],
            accepted=self.accepted,
            verdict=self.verdict(),
        )
