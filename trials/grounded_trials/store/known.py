"""Trials and candidates from the index, whose arrays are read from their files on first access."""

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
    """A trial whose arrays are read on first access."""

    @classmethod
    def of(cls, load: Callable[[], Trial], about: dict[str, Any], worth: Worth) -> KnownTrial:
        """Create a trial from its index entry; `load` reads the file, `worth` caches utilities."""
        made = object.__new__(cls)
        held = about["start_inputs"]
        vars(made).update(
            dt=about["dt"],
            state_names=tuple(about["states"]),
            input_names=tuple(about["inputs"]),
            id=about["id"],
            candidate=about["candidate"],
            start_inputs=None if held is None else readonly(held),
            start_states=about["start_states"],
            _known=about,
            _load=load,
            _worth=worth,
        )
        return made

    @cached_property
    def states(self) -> Array:
        """(T + 1, n), read on first access."""
        return cast(Array, vars(self)["_load"]().states)

    @cached_property
    def inputs(self) -> Array:
        """(T, m), read on first access."""
        return cast(Array, vars(self)["_load"]().inputs)

    @property
    def steps(self) -> int:
        """T, without reading the arrays."""
        return self._of("steps")

    @property
    def finite_steps(self) -> int:
        """As `Trial.finite_steps`, without reading the arrays."""
        return self._of("finite_steps")

    @property
    def known_steps(self) -> int:
        """As `Trial.known_steps`, without reading the arrays."""
        return self._of("known_steps")

    def _of(self, name: str) -> int:
        known = vars(self).get("_known")  # a changed copy has none
        return int(known[name] if known else getattr(Trial, name).fget(self))

    def repeats(self, other: Trial) -> bool:
        """As `Trial.repeats`, by comparing the hashes of the states where they are known."""
        mine, its = (vars(one).get("_known", {}).get("print") for one in (self, other))
        return bool(mine == its) if mine and its else super().repeats(other)

    def worth(self, task: str, compute: Callable[[], float]) -> float:
        """Return the utility in a task, computed once."""
        worth = vars(self).get("_worth")
        return compute() if worth is None else worth(task, compute)


class KnownCandidate(Candidate):
    """A candidate whose policy and prediction are read on first access."""

    @classmethod
    def of(cls, load: Callable[[], Candidate], about: dict[str, Any]) -> KnownCandidate:
        """Create a candidate whose fields, except for the arrays, are in `about`."""
        made = object.__new__(cls)
        vars(made).update(about, _load=load)
        return made

    @cached_property
    def _read(self) -> Candidate:
        return cast(Candidate, vars(self)["_load"]())

    @cached_property
    def policy(self) -> Policy:
        """What the robot runs, read on first access."""
        return self._read.policy

    @cached_property
    def predicted_states(self) -> Array:
        """(H + 1, n), read on first access."""
        return self._read.predicted_states

    @cached_property
    def predicted_inputs(self) -> Array:
        """(H, m), read on first access."""
        return self._read.predicted_inputs
