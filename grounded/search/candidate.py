"""Candidate, a policy to run and how it was made, and Tried, a candidate with its trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from grounded.frozen import Array
from grounded.policy import Policy
from grounded.result import Result, document, figure, shown
from grounded.trial import Trial

if TYPE_CHECKING:
    from grounded.figures import Figure

Way = Literal[
    "",  # a step along the direction of the model that replays the incumbent's trial
    "slopes by step",  # with derivatives corrected step by step (`believed_by_step`)
    "gentler gains",  # the incumbent's plan with lower gains (`Maker.gentler`)
    "own plan",  # the plan of a model changed since the incumbent was planned (`About.own_plan`)
]

BY_STEP: Way = "slopes by step"

Slopes = Literal[
    "",  # the model's own
    "corrected",  # from the mispredictions of earlier trials, see `mispredictions`
]

# fraction of the best cost below which a doubtful gain is no reason to continue
DOUBTFUL_GAIN = 0.1
IMPROVED = 0.95  # probability of an improvement from which it counts as one
UNSTEADY = 0.5  # standard deviation of a candidate's runs, as a share of their cost


@dataclass(frozen=True, eq=False, repr=False)
class Candidate(Result):
    """A policy to run, and how it was made."""

    id: str  # c0001, c0002 ... in the order of proposal
    policy: Policy
    iteration: int  # i of the theta^(i) that it would become; 0 for the model's own policy
    alpha: float
    base: str  # id of the candidate that it was derived from, "" for the model's own policy
    model: str  # fingerprint of the planning model
    predicted_states: Array  # (H + 1, n) in the (biased) model
    predicted_inputs: Array  # (H, m)
    predicted_utility: float
    damping: float = 1.0  # lambda of `step_size`
    predicted_gain: float = float("nan")  # predicted utility less that of its base in the model
    caution: float = 0  # how often the first policy, or its gains, were made gentler
    way: Way = ""  # how it was made
    slopes: Slopes = ""  # derivatives of the model that it was planned in
    sample_age: float = 0.0  # [s] of the samples that the robot acts on, allowed for in it
    seen: tuple[str, ...] = ()  # ids of the search's trials that were known when it was made
    units: Mapping[str, str] = field(default_factory=dict)  # of states and inputs, for figures

    @property
    def predicted_run(self) -> Trial:
        """The predicted run in the form of a robot's log."""
        made = self.policy
        names = (made.state_names, made.input_names)
        return Trial(
            self.predicted_states, self.predicted_inputs, made.dt, *names, start_inputs=made.past
        )

    @property
    def grounded(self) -> bool:
        """Whether it is a step along a direction, predicted by a model that replays a trial."""
        return bool(self.base) and self.way in ("", BY_STEP)

    @property
    def of_model_alone(self) -> bool:
        """Whether it is an optimal policy of a model that replays no trial."""
        return not self.base or self.way == "own plan"

    def promised_over(self, best: Tried) -> float:
        """Return the predicted gain over the best so far; every report uses this number.

        For a step from it, that is the gain within the model. It is never more than what of the
        best one's cost is not sensor noise, of which a plan that replays single runs seems to
        remove some.
        """
        own, most = best.candidate.id == self.base, -best.utility - best.noise_cost
        gain = self.predicted_gain if own else self.predicted_utility - best.utility
        return min(gain, most) if most > 0 else gain

    @property
    def of_corrected(self) -> bool:
        """Whether it was planned with derivatives corrected by laws of the whole run."""
        return self.slopes == "corrected" and self.way != BY_STEP

    def summary(self) -> str:
        """Return the id, the step and the predicted utility."""
        predicted = f"predicted utility {self.predicted_utility:.4g}"
        return f"{self.id}: iteration {self.iteration}, alpha {self.alpha:g}, {predicted}"

    def to_json(self) -> dict[str, Any]:
        """Return how it was made; `grounded export` writes the policy itself."""
        return document(
            candidate=self.id,
            iteration=self.iteration,
            alpha=self.alpha,
            damping=self.damping if self.base else None,
            base=self.base or None,
            predicted_utility=self.predicted_utility,
        )

    def figures(self) -> Sequence[Figure]:
        """Return the figure of the predicted states and inputs over time."""
        from grounded.figures import Figure, curve, panel  # that no `ingest` draws

        columns = [*zip(self.policy.state_names, self.predicted_states.T, strict=True)]
        columns += zip(self.policy.input_names, self.predicted_inputs.T, strict=True)
        panels = []
        for name, values in columns:
            times = np.arange(len(values), dtype=np.float64) * self.policy.dt
            drawn = curve(times, values, "predicted", "predicted")
            unit = shown(self.units.get(name, ""))
            title = f"{name} [{unit}]" if unit else name
            panels.append(panel(title, "time [s]", unit, [drawn], kind="time"))
        title = f"{self.id}: predicted utility {figure(self.predicted_utility)}"
        return (Figure("candidate", title, "", panels),)


@dataclass(frozen=True, eq=False, repr=False)
class Tried(Result):
    """A candidate with its trials: mean utility and, if repeats allow, its standard error."""

    candidate: Candidate
    trials: tuple[Trial, ...]
    utilities: tuple[float, ...]
    accepted: bool | None  # None: undecided, trials are missing
    in_doubt: bool = False  # undecided because the best one is to be run again
    noise_cost: float = 0.0  # cost of sensor noise in its logs
    noise_missed: float = 0.0  # of sensor noise, which its prediction lacks
    deviation: float = float("nan")  # standard deviation of a single run, from repeats (`Repeats`)
    probability: float = float("nan")  # that it beats the best before it; NaN: nothing is repeated
    unsure: bool = False  # runs may differ by as much as it gained (`Difference.sure`)
    gone: tuple[str, ...] = ()  # trials that it was made from and that were discarded since
    asked: bool = False  # whether its last trial is to be discarded, unless the user goes on

    @cached_property
    def utility(self) -> float:
        """Mean utility of the trials; nan without a trial, -inf if one of them failed."""
        return float(np.mean(self.utilities)) if self.utilities else float("nan")

    def gain_over(self, other: Tried) -> float:
        """Return by how much its mean utility exceeds another's."""
        return self.utility - other.utility

    @property
    def promised(self) -> float:
        """Predicted utility of its logs, including all of the sensor noise that these contain."""
        return self.candidate.predicted_utility - self.noise_missed

    @property
    def is_unsteady(self) -> bool:
        """Whether its runs scatter by about as much as they cost.

        Noise in many samples scatters far less than it costs. So something else decides how a run
        goes, such as where dry friction holds, and another policy may well be steadier.
        """
        return bool(self.deviation > UNSTEADY * abs(self.utility))

    @cached_property
    def standard_error(self) -> float:
        """Standard error of the mean utility; nan without comparable repeats or if a run failed."""
        if not self.utilities or not np.isfinite(self.utilities).all():
            return float("nan")
        return float(self.deviation / np.sqrt(len(self.utilities)))

    @property
    def void(self) -> bool:
        """Whether it was not run, and was made from a trial that was discarded since."""
        return bool(self.gone) and not self.trials

    @property
    def lost(self) -> bool:
        """Whether it counts as a step that did not improve.

        A step by derivatives that were learnt from trials discarded since says nothing about those
        of the trials that are left.
        """
        return self.accepted is False and not (self.gone and self.candidate.slopes)

    @property
    def crashed(self) -> bool:
        """Whether one of its trials did not run to the end, so that it has no utility."""
        return self.utility == -np.inf

    @property
    def failed(self) -> tuple[str, ...]:
        """Ids of its trials that did not run to the end."""
        each = zip(self.trials, self.utilities, strict=True)
        return tuple(trial.id for trial, utility in each if utility == -np.inf)

    def verdict(self, last: bool = True) -> str:
        """Return the verdict: first, better, no better, crashed; or why it is undecided.

        That of a candidate whose last run is to be discarded is "in doubt".

        It is "maybe better" if its runs were better, but by no more than they may scatter.

        Args:
            last: whether it is the latest candidate; an earlier one without a trial gets "no
                trial" instead of "waiting".
        """
        if self.asked:
            return "in doubt"
        if self.in_doubt:
            return "in doubt"
        if self.accepted is None:
            return "waiting" if last or self.trials else "no trial"
        if not self.accepted:
            return "crashed" if self.crashed else "no better"
        if not self.candidate.base:
            return "first"
        return "maybe better" if self.unsure else "better"

    def summary(self) -> str:
        """Return the id, the utility and the verdict."""
        mean = f"utility {self.utility:.4g}, trials {len(self.trials)}"
        return f"{self.candidate.id}: {mean}, {self.verdict()}"

    def to_json(self) -> dict[str, Any]:
        """Return the candidate's document with the utility of its trials and the verdict."""
        return self.candidate.to_json() | document(
            utility=self.utility,
            standard_error=self.standard_error,
            probability=self.probability,
            noise_cost=self.noise_cost,
            trials=[trial.id for trial in self.trials],
            accepted=self.accepted,
            verdict=self.verdict(),
        )
