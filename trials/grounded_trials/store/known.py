"""Trials and candidates known but for their numbers, which are read when they are asked for."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any, cast

from grounded.frozen import Array, readonly
from grounded.policy import Policy
from grounded.search.candidate import Candidate
from grounded.trial import Trial

Worth = Callable[[str, Callable[[], float]], float]


class KnownTrial(Trial):
    """A trial whose numbers are read when they are asked for."""

    @classmethod
    def of(cls, load: Callable[[], Trial], about: dict[str, Any], worth: Worth) -> KnownTrial:
        """A trial of which `about` is known; `load` reads it, `worth` keeps its utility."""
        made = object.__new__(cls)
        held = about["start_inputs"]
        vars(made).update(
            dt=about["dt"],
            state_names=tuple(about["states"]),
            input_names=tuple(about["inputs"]),
            id=about["id"],
            candidate=about["candidate"],
            start_inputs=None if held is None else readonly(held),
            _known=about,
            _load=load,
            _worth=worth,
        )
        return made

    @cached_property
    def states(self) -> Array:
        """(T + 1, n), read now."""
        return cast(Array, vars(self)["_load"]().states)

    @cached_property
    def inputs(self) -> Array:
        """(T, m), read now."""
        return cast(Array, vars(self)["_load"]().inputs)

    @property
    def steps(self) -> int:
        """T, without reading the numbers."""
        return self._of("steps")

    @property
    def finite_steps(self) -> int:
        """As a trial's, without reading the numbers."""
        return self._of("finite_steps")

    @property
    def known_steps(self) -> int:
        """As a trial's, without reading the numbers."""
        return self._of("known_steps")

    def _of(self, name: str) -> int:
        known = vars(self).get("_known")  # a changed copy has none
        return int(known[name] if known else getattr(Trial, name).fget(self))

    def repeats(self, other: Trial) -> bool:
        """As a trial's, by the hash of finite states."""
        mine, its = (vars(one).get("_known", {}).get("print") for one in (self, other))
        return bool(mine == its) if mine and its else super().repeats(other)

    def worth(self, task: str, compute: Callable[[], float]) -> float:
        """The utility in a task, computed once."""
        worth = vars(self).get("_worth")
        return compute() if worth is None else worth(task, compute)


class KnownCandidate(Candidate):
    """A candidate whose policy and prediction are read when they are asked for."""

    @classmethod
    def of(cls, load: Callable[[], Candidate], about: dict[str, Any]) -> KnownCandidate:
        """A candidate of whose fields `about` holds all but the numbers; `load` reads it."""
        made = object.__new__(cls)
        vars(made).update(about, _load=load)
        return made

    @cached_property
    def _read(self) -> Candidate:
        return cast(Candidate, vars(self)["_load"]())

    @cached_property
    def policy(self) -> Policy:
        """What the robot runs, read now."""
        return self._read.policy

    @cached_property
    def predicted_states(self) -> Array:
        """(H + 1, n), read now."""
        return self._read.predicted_states

    @cached_property
    def predicted_inputs(self) -> Array:
        """(H, m), read now."""
        return self._read.predicted_inputs
