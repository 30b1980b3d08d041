"""Model and Param: the crude dynamics model, with named states, inputs and parameters.

A model is a function of named states `s`, inputs `a` and parameters `p` in plain NumPy,

    derivative(s, a, p) -> ds/dt        or        step(s, a, p, dt) -> next state,

both returning a dict by state name. Internally, states and inputs are arrays in the order of their
declaration: `x` and `u` as in the control literature. `s` and `a` (the paper's letters) are the
named values that the user's function receives.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from itertools import chain
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from grounded.checks import finite, known, of_type, one_of, refused, unknown, whole_number, wrong
from grounded.compile import Kind, Signature, system_of
from grounded.errors import alike
from grounded.frozen import Array, readonly, wrapped

if TYPE_CHECKING:
    from grounded.compile.run.interpreted import System

Function = Callable[..., Mapping[str, Any]]
MAX_SUBSTEPS = 1000
ROLES = (
    *("position", "altitude", "heading", "attitude", "heading_rate", "rates", "speed"),
    *("steering_angle", "hanging", "upright", "level", "rail"),
)
BELIEVED = 3.0  # prior standard deviations (as given by the user) that a parameter may move
# smallest fraction of its value, without a bound towards zero: the sign is known
SMALLEST_SHARE = 0.2
MAX_SIZE = 200  # states plus inputs: the cost of a step grows with the cube of this number


@dataclass(frozen=True)
class Param:
    """A model parameter: constant if only a value is given, uncertain with bounds or a `std`.

    A constant (a mass that was weighed, g) is never fitted or changed by a diagnosis. An uncertain
    parameter is estimated within its bounds, with its prior as a regulariser.

    Args:
        value: nominal value, in `unit`.
        unit: unit for display, "1" if dimensionless.
        low: lower bound, in `unit`; None for no bound.
        high: upper bound, in `unit`; None for no bound.
        std: prior standard deviation, in `unit`; None for that of a uniform distribution between
            the bounds.

    Raises:
        GroundedError: if a number is not finite, the bounds are reversed, the value lies outside
            them, or `std` is not positive.
    """

    value: float
    unit: str = "1"
    low: float | None = None
    high: float | None = None
    std: float | None = None

    def __post_init__(self) -> None:
        numbers = [self.value] + [n for n in (self.low, self.high, self.std) if n is not None]
        for one in numbers:
            of_type("a parameter's number", one, int, float, np.number)
        finite("a parameter's value", self.value)
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        if low > high:
            raise wrong("bounds of a parameter", [low, high], must="ascending")
        if not low <= self.value <= high:
            raise wrong("a parameter's value", self.value, low=low, high=high)
        if self.std is not None and not (np.isfinite(self.std) and self.std > 0):
            raise wrong("a parameter's std", self.std, must="positive")

    @property
    def uncertain(self) -> bool:
        """Whether the parameter may be estimated: it has bounds that differ, or a `std`."""
        given = self.low is not None or self.high is not None or self.std is not None
        return given and self.low != (np.nan if self.high is None else self.high)

    def at_bound(self, value: float) -> bool:
        """Return whether a value lies on one of the bounds."""
        ends = [end for end in (self.low, self.high) if self.uncertain and end is not None]
        return any(abs(value - end) <= 1e-6 * self.spread for end in ends)

    def within(self, name: str, value: Any) -> None:
        """Check that a new value of the parameter lies within its bounds.

        Raises:
            GroundedError: if it does not, or is not a finite number.
        """
        if not isinstance(value, int | float | np.number) or not np.isfinite(value):
            raise wrong(name, value, must="finite")
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        if not (low <= value <= high or self.at_bound(float(value))):
            raise wrong(name, value, must="bounded", low=low, high=high, do="widen")

    @property
    def reach(self) -> tuple[float, float]:
        """Lowest and highest value that an estimate may take.

        Without a bound towards zero the sign is kept. If `std` is given, the value also stays
        within three standard deviations of the nominal one. Otherwise evidence of model errors
        elsewhere could change a measured length by a factor of five.
        """
        far = np.inf if self.std is None else BELIEVED * self.std
        low = (
            (SMALLEST_SHARE * self.value if self.value > 0 else -np.inf)
            if self.low is None
            else self.low
        )
        high = (
            (SMALLEST_SHARE * self.value if self.value < 0 else np.inf)
            if self.high is None
            else self.high
        )
        return max(low, self.value - far), min(high, self.value + far)

    def stopped(self, value: float) -> str:
        """Return what stopped a fitted value: "bound", "prior" (its `reach`) or "" for nothing."""
        if self.at_bound(value):
            return "bound"
        ended = any(abs(value - end) <= 1e-6 * self.spread for end in self.reach)
        return "prior" * (self.uncertain and ended)

    @property
    def spread(self) -> float:
        """Prior standard deviation, in `unit`.

        0 for a constant, `std` if given, half of the absolute value if only one bound is given,
        else that of a uniform distribution between the bounds.
        """
        if not self.uncertain:
            return 0.0
        if self.std is not None:
            return self.std
        if self.low is None or self.high is None:
            return 0.5 * abs(self.value)
        return (self.high - self.low) / 12**0.5


def is_clock(state: str) -> bool:
    """Return whether a memory state is the time since the start; it advances even at rest."""
    return state.endswith("_clock")


@dataclass(frozen=True, eq=False)
class Model:
    """A dynamics model: named states and inputs with units, parameters and their equations.

    Give either `derivative` (continuous time) or `step` (discrete time).

    Args:
        states: unit of each state by name; n states.
        inputs: unit of each input by name; m inputs.
        params: `Param` by name.
        angles: names of states in rad whose differences wrap to [-pi, pi].
        roles: optional meaning of states, as role -> state name (`position`, `heading`, `speed`
            ...), used by effects and plots. `position` names one state along an axis, two in a
            plane (horizontal first) or three.
        derivative: function (s, a, p) -> dict of ds/dt by state name, in the state's unit per
            second; integrated over a control step with the inputs held (zero-order hold).
        step: function (s, a, p, dt) -> dict of the next state by name; any Python callable.
        integrator: "rk4" or "euler"; used with `derivative`.
        name: name of the model in messages and files.
        substeps: integrator steps within a control step; increase it for stiff models.
        jacobian: function (s, a, p, dt) -> (f_x (n, n), f_u (n, m)), the derivatives of `step`;
            with a leading sample axis if the states are arrays. None to differentiate
            automatically.

    Raises:
        GroundedError: for a name that is used twice or is not a Python identifier, an unknown angle
            or role, or if not exactly one of `derivative` and `step` is given.
    """

    states: Mapping[str, str]
    inputs: Mapping[str, str]
    params: Mapping[str, Param] = field(default_factory=dict)
    angles: tuple[str, ...] = ()
    roles: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    derivative: Function | None = None
    step: Function | None = None
    integrator: Literal["rk4", "euler"] = "rk4"
    name: str = "model"
    substeps: int = 1
    jacobian: Callable[..., tuple[Any, Any]] | None = None

    def __post_init__(self) -> None:
        for attribute in ("states", "inputs", "params", "roles"):
            given = getattr(self, attribute)
            if not isinstance(given, Mapping):
                like = "{'x': 'm', 'v': 'm/s'}"
                raise wrong(f"a model's {attribute}", given, must="dict", like=like)
            value = dict(given)
            if attribute == "roles" and isinstance(value.get("position"), str):
                value["position"] = (value["position"],)
            object.__setattr__(self, attribute, MappingProxyType(value))
        object.__setattr__(self, "angles", tuple(self.angles))
        if (self.derivative is None) == (self.step is None):
            both = ("derivative= (ds/dt)", "step= (next state)")
            raise refused("given.either", *both, how="one")
        one_of("integrator", self.integrator, ("rk4", "euler"))
        whole_number("substeps", self.substeps, 1, MAX_SUBSTEPS)
        if self.step is not None and self.substeps > 1:
            raise refused("given.either", "derivative=", "substeps=", how="first")
        if self.step is None and self.jacobian is not None:
            raise refused("given.either", "step=", "jacobian=", how="first")
        if not self.states:
            raise refused("given.no_input", f"model '{self.name}'", what="state")
        if not self.inputs:
            raise refused("given.no_input", f"model '{self.name}'", what="input")
        if self.n + self.m > MAX_SIZE:
            sizes = {"states": self.n, "inputs": self.m, "most": MAX_SIZE, "what": "plan"}
            raise refused("given.large", f"model '{self.name}'", **sizes)
        self._check_names()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the arguments; another process builds the model from them."""
        given = {f.name: getattr(self, f.name) for f in fields(self)}
        given |= {key: dict(given[key]) for key in ("states", "inputs", "params", "roles")}
        return partial(Model, **given), ()

    def _check_names(self) -> None:
        of_kind = {"state": self.states, "input": self.inputs, "parameter": self.params}
        for name in chain.from_iterable(of_kind.values()):
            if (name in self.states) + (name in self.inputs) + (name in self.params) > 1:
                kinds = tuple(kind for kind, names in of_kind.items() if name in names)
                raise refused("given.twice", f"model '{self.name}'", name=name, kinds=kinds)
            if not name.isidentifier():
                raise wrong(f"a name of model '{self.name}'", name, must="name")
        units: dict[str, object] = {**self.states, **self.inputs}
        for name, param in dict[str, object](self.params).items():
            of_type(f"{self.name}.params['{name}']", param, Param)
        for name, unit in units.items():
            of_type(f"unit of '{name}' in model '{self.name}'", unit, str)
        for name in self.angles:
            known("angle among the states", [name], self.states, f"model '{self.name}'")
        place = self.roles.get("position", ())
        if len(place) > 3:
            raise wrong("role 'position'", place, must="place")
        for role, targets in self.roles.items():
            if role not in ROLES and alike(role, ROLES):  # others may be for user-defined effects
                raise unknown("role", role, ROLES)
            for name in (targets,) if isinstance(targets, str) else targets:
                known(f"signal of the role '{role}'", [name], [*self.states, *self.inputs])

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    @property
    def m(self) -> int:
        """Number of inputs."""
        return len(self.inputs)

    @cached_property
    def state_names(self) -> tuple[str, ...]:
        """Names of the states in array order."""
        return tuple(self.states)

    @cached_property
    def input_names(self) -> tuple[str, ...]:
        """Names of the inputs in array order."""
        return tuple(self.inputs)

    @cached_property
    def param_names(self) -> tuple[str, ...]:
        """Names of the parameters in array order."""
        return tuple(self.params)

    @cached_property
    def uncertain(self) -> tuple[str, ...]:
        """Names of the uncertain parameters in array order."""
        return tuple(name for name, param in self.params.items() if param.uncertain)

    @cached_property
    def values(self) -> Array:
        """Parameter values (k,), in array order."""
        values: Array = readonly([param.value for param in self.params.values()])
        return values

    @cached_property
    def spreads(self) -> Array:
        """Prior standard deviation of each parameter (k,), 0 for a constant."""
        values: Array = readonly([param.spread for param in self.params.values()])
        return values

    @cached_property
    def angle_mask(self) -> Any:
        """Which states are angles, (n,) bool."""
        return readonly(np.isin(self.state_names, self.angles), dtype=np.bool_)

    @cached_property
    def system(self) -> System:
        """The numerical model: compiled if it can be traced, else with finite differences."""
        function = self.derivative if self.derivative is not None else self.step
        assert function is not None
        return system_of(
            function,
            kind="derivative" if self.derivative is not None else "step",
            states=self.state_names,
            inputs=self.input_names,
            params=self.param_names,
            integrator=self.integrator,
            substeps=self.substeps,
            jacobian=self.jacobian,
        )

    def steps(self, x: Array, u: Array, dt: float) -> Array:
        """Return the next states (N, n) of a few samples: slowly, but nothing is compiled for it.

        NaN where the function raises an arithmetic error.
        """
        try:
            return self.whole.steps(x, u, self.values, dt)
        except Exception:  # the compiler says what is wrong with the function
            return self.system.step(x, u, self.values, dt)

    @property
    def whole(self) -> Signature:
        """The function as a step(s, a, p, dt); a derivative is integrated."""
        function = self.derivative or self.step
        assert function is not None
        kind: Kind = "derivative" if self.derivative else "step"
        names = (self.state_names, self.input_names, self.param_names)
        return Signature(function, kind, *names).whole(self.integrator, self.substeps)

    def difference(self, a: Array, b: Array) -> Array:
        """Return the difference a - b of states (..., n), with angles wrapped to [-pi, pi]."""
        return wrapped(np.asarray(a, float) - np.asarray(b, float), self.angle_mask)

    def holding(self, names: Collection[str]) -> Model:
        """Return the model with some parameters constant, at their values; itself if none is."""
        if not any(self.params[name].uncertain for name in names):
            return self
        held = {n: Param(p.value, p.unit) if n in names else p for n, p in self.params.items()}
        return replace(self, params=held)

    def with_values(self, values: Mapping[str, float]) -> Model:
        """Return a copy with other parameter values; bounds are widened to include them.

        Args:
            values: new values by parameter name, in the parameter's unit.

        Raises:
            GroundedError: for a name that is not a parameter.
        """
        params = dict(self.params)
        for name, value in values.items():
            known("parameter", [name], params, f"model '{self.name}'")
            old = params[name]
            params[name] = Param(
                float(value),
                old.unit,
                None if old.low is None else min(old.low, value),
                None if old.high is None else max(old.high, value),
                old.std,
            )
        return dataclasses.replace(self, params=params)
