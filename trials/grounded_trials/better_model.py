"""The model after the diagnosis: its parameters and effects put in, drawn beside the crude one.

A diagnosis estimates the model's parameters beside the effects, so both belong to what it claims;
once effects are adopted and nothing newer was diagnosed, it is the model that plans.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from grounded.planner import Planner
from grounded_trials.diagnosis_file import Diagnosis
from grounded_trials.workspace import Workspace


@dataclass(frozen=True, eq=False)
class Better:
    """A model to compare the crude one with, and its name in a legend."""

    planner: Planner
    name: str


def better_model(workspace: Workspace, diagnosis: Diagnosis | None) -> Better | None:
    """The diagnosed model, or else the one with adopted effects; None where there is neither.

    Raises:
        GroundedError: if the diagnosis names an effect or a quantity that is not known.
    """
    adopted = [dict(effect) for effect in workspace.config.model.effects]
    effects = adopted + _new(diagnosis, {str(effect["name"]) for effect in adopted})
    values = _parameters(workspace, diagnosis)
    if diagnosis is None or not (values or len(effects) > len(adopted)):
        return Better(workspace.planner, "with adopted effects") if adopted else None
    from grounded_trials.adopted import planner_with

    task = workspace.task
    estimated = task.with_model(task.model.with_values(values))
    return Better(planner_with(estimated, effects), "as diagnosed")


def _new(diagnosis: Diagnosis | None, adopted: set[str]) -> list[dict[str, Any]]:
    """The effects that the verdict names and the model lacks, with their quantities."""
    if diagnosis is None:
        return []
    ranked = {r.effect: r for r in diagnosis.ranking}
    return [
        {"name": name, **dict(ranked[name].fixed), **{v.name: v.value for v in ranked[name].params}}
        for name in diagnosis.effects
        if name in ranked and name not in adopted
    ]


def _parameters(workspace: Workspace, diagnosis: Diagnosis | None) -> dict[str, float]:
    """The model's parameters as the diagnosis estimated them; its own names only."""
    known = workspace.task.model.params
    found = diagnosis.parameters if diagnosis is not None else ()
    return {v.name: v.value for v in found if v.name in known and v.value == v.value}
