"""The simulated real system of the blind challenge, implemented independently of the diagnosis.

The diagnosis predicts with one step of the crude model, Strang splitting and a linear filter. The
truth is integrated at several times the control rate, with added rates inside the derivative,
actuators advanced at that fine rate, other kinds of noise, and a controller that sees the noisy
log. They share the equation of an effect, but no numerics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from grounded.challenge.mechanism import Mechanism
from grounded.compile import Named
from grounded.effects import (
    Effect,
    Family,
    InputFamily,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    RateFamily,
    SensorDelayFamily,
    SensorFamily,
    SensorLagFamily,
)
from grounded.effects.drive import speed
from grounded.effects.family import coupled
from grounded.effects.medium import over_ground, through_it
from grounded.frozen import Array
from grounded.model import Model
from grounded.places import partner
from grounded.trial import Trial

FINE = 6  # integration steps per control step
TINY = 1e-6  # step for the rate in a moving medium [s]
NUDGE = 1e-2  # finite-difference step for the slope of a rate, in an input's unit

# A withheld actuator acts on received inputs: f(u (m,), its own state, t, dt) -> u
Actuator = Callable[[Array, dict[str, Any], float, float], Array]


@dataclass(frozen=True)
class Disturbance:
    """Noise of the real system, by state: process in unit/sqrt(s), measurement in unit.

    kind: "white", "coloured" (correlated over `tau`), "heavy" (Student-t of 3, 1 % outliers).
    grows: (state, size): process noise scales with 0.2 + |state| / size.
    """

    process: Mapping[str, float]
    measurement: Mapping[str, float]
    kind: str = "white"
    tau: float = 0.1
    grows: tuple[str, float] | None = None


@dataclass(frozen=True, eq=False)
class Truth:
    """The real system: a model with true parameters, effects, disturbances, withheld parts.

    A mechanism, made for a fine step, replaces the model's derivative, and the effects that are
    built into it.
    """

    model: Model
    effects: tuple[tuple[Effect, Mapping[str, float]], ...] = ()
    disturbance: Disturbance = field(default_factory=lambda: Disturbance({}, {}))
    actuators: tuple[Actuator, ...] = ()
    rates: tuple[Callable[[Any, Any, float, Mapping[str, Any]], Mapping[str, float]], ...] = ()
    latency: tuple[float, ...] = ()
    mechanism: Callable[[float], Mechanism] | None = None

    def run(
        self,
        rng: np.random.Generator,
        controller: Callable[[int, Array], Array],
        start: Array,
        held: Array,
        steps: int,
        dt: float,
    ) -> Trial:
        """Simulate one real trial; controller(t, logged state) -> command."""
        return _Run(self, rng, start, held, dt).trial(controller, steps)


class _Run:
    """The state of one run of the truth."""

    def __init__(
        self, truth: Truth, rng: np.random.Generator, start: Array, held: Array, dt: float
    ) -> None:
        self.truth, self.rng, self.dt, self.fine = truth, rng, dt, dt / FINE
        self.x, self.held = np.array(start, float), np.array(held, float)
        model = self.model = truth.model
        self.names = model.state_names
        self.p = Named("parameter", model.param_names, list(model.values))
        self.memory: dict[str, Any] = {}
        self.own_state: dict[str, Any] = {"rng": rng}
        self.late = [divmod(by / self.fine, 1.0) for by in truth.latency or (0.0,) * model.m]
        self.settle()
        self.gust, self.last = np.zeros(model.n), self.held
        self.plant = None if truth.mechanism is None else truth.mechanism(self.fine)
        pairs = ((n, partner(model, n)) for n in self.names)
        self.tied = [(self.names.index(n), self.names.index(k)) for n, k in pairs if k is not None]
        self.tie(0.0)
        self.past = [self.x.copy()]

    def of(self, *kinds: type[Family]) -> Iterator[tuple[Effect, Any, Mapping[str, float]]]:
        """Yield the effects of some kinds of families, with the family and the values."""
        for effect, values in self.truth.effects:
            if isinstance(effect.family, kinds):
                yield effect, effect.family, values

    def trial(self, controller: Callable[[int, Array], Array], steps: int) -> Trial:
        logged, inputs = [self.measure()], []
        for t in range(steps):
            u = np.asarray(controller(t, logged[-1]), float)
            for part in range(FINE):
                self.advance(u, t * self.dt + part * self.fine)
                self.past.append(self.x.copy())
            self.disturb()
            self.tie((t + 1) * self.dt)
            self.past[-1] = self.x.copy()
            logged.append(self.measure())
            inputs.append(u)
        names, made = (self.names, self.model.input_names), (np.array(logged), np.array(inputs))
        return Trial(*made, self.dt, *names, start_inputs=self.held)

    def settle(self) -> None:
        """Initialise memories as settled at the held inputs."""
        u, names = self.held.copy(), self.model.input_names
        for effect, family, values in self.of(InputFamily, MemoryFamily, LossFamily):
            if isinstance(family, LossFamily):
                held = u[names.index(coupled(effect.site)[0])]
                self.memory[effect.name] = family.rest(held, values)
                continue
            for j in map(names.index, effect.site.targets):
                if isinstance(family, InputFamily):
                    u[j] = family.effect(u[j], 0.0, values)
                else:
                    self.memory[f"{effect.name} {j}"] = (u[j],) * family.depth(values, self.fine)
        self.queues = [[u[j]] * (int(whole) + 1) for j, (whole, _) in enumerate(self.late)]

    def received(self, u: Array, t: float) -> Array:
        """Return what the actuators deliver over a fine step."""
        out = u.copy()
        for effect, family, values in self.of(InputFamily, MemoryFamily):
            for j in map(self.model.input_names.index, effect.site.targets):
                if isinstance(family, InputFamily):
                    out[j] = family.effect(out[j], t, values)
                    continue
                z = self.memory[key := f"{effect.name} {j}"]
                out[j], self.memory[key] = family.advance(out[j], z, values, self.fine)
        for actuator in self.truth.actuators:
            out = actuator(out, self.own_state, t, self.fine)
        for j, queue in enumerate(self.queues):  # mean of the delayed input over a fine step
            part = self.late[j][1]
            queue.append(out[j])
            out[j] = (1 - part) * queue[1] + part * queue[0]
            queue.pop(0)
        return out

    def rates(self, x: Array, u: Array, t: float) -> Array:
        """Return ds/dt of the real system over ground, in a moving medium if there is one."""
        s = Named("state", self.names, list(x))
        for effect, _, values in self.of(MediumFamily):
            seen = np.array(list(through_it(effect, s, values).values()))
            ahead = [*(seen + TINY * self.through_the_medium(seen, u, t))]
            after = over_ground(effect, Named("state", self.names, ahead), values, TINY)
            return (np.array([after[n] for n in self.names]) - x) / TINY
        return self.through_the_medium(x, u, t)

    def through_the_medium(self, x: Array, u: Array, t: float) -> Array:
        """Return ds/dt of states through the medium, with all other effects."""
        derivative, inputs = self.model.derivative, self.model.input_names
        s, a = Named("state", self.names, list(x)), Named("input", inputs, list(u))
        assert derivative is not None
        own = dict(derivative(s, a, self.p))
        for effect, family, values in self.of(LossFamily):
            tau = coupled(effect.site)[0]
            more = derivative(s, _with(a, tau, a[tau] + NUDGE), self.p)
            w, rate, then = (speed(effect, one) for one in (s, own, more))
            c = {**values, **self.memory[effect.name]}
            lost = family.torque(w, rate, (then - rate) / NUDGE, a[tau], c)
            a = _with(a, tau, a[tau] - lost)
            own = dict(derivative(s, a, self.p))
        added = [f.rate(s, a, own, t, values, e.site) for e, f, values in self.of(RateFamily)]
        total = {n: float(own[n]) for n in self.names}
        for one in (*added, *(extra(s, a, t, own) for extra in self.truth.rates)):
            for n, value in one.items():
                total[n] += float(value)
        return np.array([total[n] for n in self.names])

    def advance(self, u: Array, t: float) -> None:
        """Take one fine step, by the midpoint rule or by MuJoCo."""
        received = self.last = self.received(u, t)
        if self.plant is not None:
            self.x = self.plant.advance(self.x, received)
            return
        start, memory = self.x, self.memory
        half = start + 0.5 * self.fine * self.rates(start, received, t)
        self.memory = memory | self.remembered(start, half, received, 0.5 * self.fine)
        self.x = start + self.fine * self.rates(half, received, t + 0.5 * self.fine)
        self.memory = memory
        self.memory = memory | self.remembered(start, self.x, received, self.fine)

    def remembered(self, x: Array, after: Array, u: Array, dt: float) -> dict[str, Any]:
        """Return the memories of losses after a motion from x to `after` (n,) with u (m,)."""
        found, inputs = dict[str, Any](), self.model.input_names
        for effect, family, values in self.of(LossFamily):
            w, end = (speed(effect, dict(zip(self.names, s, strict=True))) for s in (x, after))
            sent, c = u[inputs.index(coupled(effect.site)[0])], self.memory[effect.name]
            found[effect.name] = family.later(w, end, 0.0, sent, {**values, **c}, dt)
        return found

    def tie(self, t: float) -> None:
        """Set heading rates that the model only carries along to the heading's true rate."""
        if self.tied:
            rates = self.rates(self.x, self.last, t)
            for heading, rate in self.tied:
                self.x[rate] = rates[heading]

    def disturb(self) -> None:
        """Add process noise over a control step."""
        noise, dt = self.truth.disturbance, self.dt
        scale = np.array([noise.process.get(n, 0.0) for n in self.names])
        if noise.grows is not None:
            name, size = noise.grows
            scale = scale * (0.2 + abs(self.x[self.names.index(name)]) / size)
        if noise.kind == "coloured":  # the same spectrum at low frequencies as the white noise
            phi = np.exp(-dt / noise.tau)
            kick = self.rng.standard_normal(len(scale)) * np.sqrt(1 - phi**2)
            self.gust = phi * self.gust + kick
            self.x = self.x + self.gust * scale * dt / np.sqrt(2 * noise.tau)
            return
        self.x = self.x + scale * np.sqrt(dt) * self._draw(len(scale))

    def _draw(self, count: int) -> Array:
        if self.truth.disturbance.kind == "heavy":
            return np.asarray(self.rng.standard_t(3, count) / np.sqrt(3.0))
        return self.rng.standard_normal(count)

    def measure(self) -> Array:
        """Return the logged state at this moment."""
        noise = self.truth.disturbance
        y = self.x.copy()
        for effect, family, values in self.of(SensorFamily, SensorDelayFamily, SensorLagFamily):
            for i in map(self.names.index, effect.site.targets):
                if isinstance(family, SensorFamily):
                    y[i] = family.measure(y[i], values)
                elif isinstance(family, SensorDelayFamily):
                    y[i] += self._old(i, values["d"]) - self.x[i]
                else:
                    y[i] += self._filtered(i, values["tau"]) - self.x[i]
        scale = np.array([noise.measurement.get(n, 0.0) for n in self.names])
        v = self._draw(len(scale))
        if noise.kind == "heavy":
            hit = self.rng.random(len(scale)) < 0.01
            v = v + hit * self.rng.choice([-1, 1], len(scale)) * self.rng.uniform(5, 10, len(scale))
        return np.asarray(y + scale * v)

    def _old(self, i: int, delay: float) -> float:
        """Return state i of `delay` seconds ago; it was constant before t = 0."""
        back = delay / self.fine
        k, part = int(back), back - int(back)
        last = len(self.past) - 1
        new, old = self.past[max(last - k, 0)][i], self.past[max(last - k - 1, 0)][i]
        return float((1 - part) * new + part * old)

    def _filtered(self, i: int, tau: float) -> float:
        """Return state i through a first-order filter at the fine rate, settled at the start."""
        part, found = 1 - np.exp(-self.fine / tau), self.past[0][i]
        for x in self.past[1:]:
            found = found + part * (x[i] - found)
        return float(found)


def _with(inputs: Named, name: str, value: Any) -> Named:
    """Return the inputs with another value of one."""
    return Named("input", tuple(inputs), [value if n == name else inputs[n] for n in inputs])
