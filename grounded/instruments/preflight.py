"""START HERE: the instruments, from their own signals alone, before any physics is judged.

odd_trial     a whole trial in other units than the rest
clocks        one pace of the stamps behind several rates that are off, states that answer early
other_units   a position in mm beside a velocity in m/s
swapped       two columns of a trial in each other's place
way           speeds in the axes of positions or in knots, a compass's heading
mismatch      a position that doesn't move as velocities and angles say
single        each state by itself
dead          a velocity that stays at one value while its position moves
constant      a velocity that is off by a constant, against the way of its position
kinematics    velocities against the rates of their positions, courses against headings
late_position both positions of a plane behind what velocities and a heading say
mistaken      commands in each other's place, or in percent, once the rest is put right
inputs        copies of one another, at their limits or beyond, constant within each trial

What is certain from sensors alone is put right in the trials that the diagnosis then takes: a late
signal is moved, a wrong sign or unit undone, samples that show nothing become missing ones; what a
sensor filters, the diagnosis' own filter knows (`Preflight.filters`). What
could be physics as well, a scale a few percent off, a slipping wheel, is stated and left alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.clocks import told_by_the_clock
from grounded.instruments.constant import constant_of
from grounded.instruments.dead import judge_dead
from grounded.instruments.finding import (
    DEGREES,
    Finding,
    a_mean,
    filters_of,
    in_degrees,
    put_right,
    scaled,
)
from grounded.instruments.inputs import judge_inputs
from grounded.instruments.kinematics import (
    AGREE,
    OFF,
    TURNED_AWAY,
    Integral,
    differenced,
    integrals,
    judge_speed,
    lag_of,
    logged_behind,
    own_lag,
    travelled,
)
from grounded.instruments.lag import LEAST_S, SURE, Lag, earlier
from grounded.instruments.late_position import late_positions
from grounded.instruments.mismatch import (
    Mismatch,
    explained,
    stop_at,
    stop_at_folded,
    unexplained,
)
from grounded.instruments.odd_trial import (
    Odd,
    Ratios,
    all_in_degrees,
    judge_stamps,
    odd_commands,
    odd_states,
    ratios_of,
)
from grounded.instruments.other_units import judge_units
from grounded.instruments.rows import kinematic_rows, tied
from grounded.instruments.single import judge_signal, signal_of
from grounded.instruments.swapped import judge_columns
from grounded.instruments.way import judge_way, rate_agrees
from grounded.model import Model
from grounded.task import Task
from grounded.trial import Trial

LEAST_STEPS = 0.1  # of a time step: less is a matter of time stamps
ALIKE = 0.9  # coherence from which two sensors are compared at all
UNIT = 0.1  # relative, from which a scale is taken for one of degrees
SMOOTH = 2.0  # time steps: a velocity that is a mean over less still tells when something happens


@dataclass(frozen=True, eq=False)
class Preflight:
    """What was found of the instruments, and the trials without what could be corrected."""

    findings: tuple[Finding, ...]
    trials: tuple[Trial, ...]
    in_step: frozenset[str] = frozenset()  # states whose sensors were seen to show one moment
    refuted: frozenset[str] = frozenset()  # effects that would part two sensors that agree

    @property
    def filters(self) -> dict[str, float]:
        """Time constants of the sensors that filter, by state [s]."""
        return filters_of(self.findings)

    @property
    def left_out(self) -> frozenset[str]:
        """States whose sensors say no more than others do."""
        return frozenset(f.signal for f in self.findings if f.kind == "smoothed")

    @property
    def settled(self) -> frozenset[str]:
        """Sensor effects that can't be blamed any more, by name: corrected, or refuted."""
        mended = {f.signal for f in self.findings if f.corrected and f.kind in ("delay", "lag")}
        return self.refuted | frozenset(
            f"{family}:{name}"
            for name in self.in_step | mended
            for family in ("sensor_delay", "sensor_lag")
        )


def preflight(
    subject: Task | Model, trials: Sequence[Trial], hidden: Sequence[str] = ()
) -> Preflight:
    """Judges the instruments of trials that fit the model.

    Args:
        subject: the model, whose kinematics tie sensors together; of a task also the limits.
        trials: real ones, of one time grid.
        hidden: states that no sensor has.
    """
    model = subject.model if isinstance(subject, Task) else subject
    names = (model.state_names, model.input_names)
    used = [trial for trial in trials if trial.known_steps >= 2]
    if not used or any((trial.state_names, trial.input_names) != names for trial in used):
        return Preflight((), tuple(trials))
    bench = _Bench(model, [t.until(t.known_steps) for t in used], set(hidden))
    with np.errstate(all="ignore"):
        ratios = ratios_of(model, bench.trials, bench.shown)
        judge_stamps(model, bench.trials, ratios)
        judge_units(model, bench.trials, ratios, bench.shown)
        judge_columns(model, bench.trials, bench.shown)
        mended = [*judge_way(model, bench.trials, bench.rows), *bench.mismatched()]
        found = [
            *bench.dead(),
            *mended,
            *bench.odd(ratios_of(model, bench.trials, bench.shown) if mended else ratios),
            *bench.singles(),
            *bench.pairs(),
            *bench.positions(),
            *bench.plane(),
            *unexplained(model, bench.trials, bench.rows),
            *judge_inputs(subject, bench.trials),
        ]
    in_step, refuted = frozenset(bench.in_step), frozenset(bench.refuted)
    found = told_by_the_clock(model, trials, found, refuted)
    return Preflight(tuple(found), tuple(bench.trials), in_step, refuted)


class _Bench:
    """Trials that are corrected finding by finding."""

    def __init__(self, model: Model, trials: list[Trial], hidden: set[str]) -> None:
        self.model, self.trials = model, trials
        self.shown = [i for i, n in enumerate(model.state_names) if n not in hidden]
        self.in_step, self.refuted = set[str](), set[str]()
        self.rows = tied(kinematic_rows(model, self.shown))

    @property
    def dt(self) -> float:
        return self.trials[0].dt

    def column(self, i: int) -> list[Array]:
        return [trial.states[:, i] for trial in self.trials]

    def put(self, i: int, columns: Sequence[Array]) -> None:
        """The trials with other samples of one state."""
        for k, (trial, x) in enumerate(zip(self.trials, columns, strict=True)):
            states = np.array(trial.states)
            states[:, i] = x
            self.trials[k] = replace(trial, states=states)

    def mismatched(self) -> Iterator[Finding]:
        """Of signs and degrees by rows of several sensors; stops at other units and exchanges."""
        found = explained(self.model, self.trials, self.rows, self.shown)
        stop_at(self.model, self.trials, found)
        if not found:
            stop_at_folded(self.model, self.trials, self.rows)
        for one in found:
            yield from self.without(one)

    def without(self, one: Mismatch) -> Iterator[Finding]:
        """With a sign or degrees put right."""
        for k in one.trials:
            self.trials[k] = one.change.mended(self.trials[k])
        ids = [self.trials[k].id or f"number {k + 1}" for k in one.trials]
        where = f" in trial{'s' * (len(ids) > 1)} {', '.join(ids)}"
        where *= len(ids) < len(self.trials)
        for i in one.change.states:
            name = self.model.state_names[i]
            if one.change.factor > 0:
                text = f"is in degrees{where}, not in {self.model.states[name]}"
                log = f"scale = {1 / DEGREES:.8g}" * (not where)
                yield put_right(name, text, "degrees", log, scale=DEGREES)
            else:
                text = f"has the wrong sign{where}: only so do positions move as the others say"
                yield put_right(name, text, "sign", "scale = -1" * (not where), scale=-1.0)

    def dead(self) -> Iterator[Finding]:
        """With the samples of velocities that show nothing missing."""
        for k, one in judge_dead(self.model, self.trials, self.shown):
            states = np.array(self.trials[k].states)
            states[:, one.relation.j] = np.nan
            where = f" in trial {self.trials[k].id or f'number {k + 1}'}"
            self.trials[k] = replace(self.trials[k], states=states)
            name = self.model.state_names[one.relation.j]
            yield Finding(name, one.told(self.model, where), "stuck", corrected=True)

    def odd(self, ratios: Sequence[Ratios]) -> Iterator[Finding]:
        """Of trials that are in other units than the rest, as a whole or in one signal."""
        shown = [i for i in self.shown if all(np.isfinite(x).any() for x in self.column(i))]
        for odd in list(odd_states(self.model, self.trials, ratios, shown)):
            yield from self.in_unit(odd)
        for odd in all_in_degrees(self.model, self.trials, shown):
            self.trials[odd.trial] = odd.mended(self.trials[odd.trial])
            if odd.trial == 0:
                yield from (in_degrees(n, unit) for n, unit in self.named(odd))
        for odd in list(odd_commands(self.model, self.trials, shown)):
            yield from self.in_unit(odd)

    def in_unit(self, odd: Odd) -> Iterator[Finding]:
        """With one trial in the unit of the others; no line for the table of all logs."""
        trial = self.trials[odd.trial]
        self.trials[odd.trial] = odd.mended(trial)
        where = f"in trial {trial.id or f'number {odd.trial + 1}'}"
        text = f"is in degrees {where}, in radians in others"
        if abs(odd.factor / DEGREES - 1) > UNIT or odd.inputs:
            size = f"{max(odd.factor, 1 / odd.factor):.4g} times too"
            text = f"is {size} {'large' if odd.factor > 1 else 'small'} {where}"
        degrees = abs(abs(np.log(odd.factor)) - np.log(DEGREES)) < UNIT
        for name, _ in self.named(odd):
            kind = "degrees" if degrees else "scale"
            yield put_right(name, text, kind, "", scale=odd.factor)

    def named(self, odd: Odd) -> list[tuple[str, str]]:
        """Names and units of its signals."""
        states, inputs = list(self.model.states.items()), list(self.model.inputs.items())
        return [states[i] for i in odd.states] + [inputs[j] for j in odd.inputs]

    def singles(self) -> Iterator[Finding]:
        """Of each sensor by itself."""
        for i in self.shown:
            signal = signal_of(self.model, self.trials, i, self.shown)
            findings, after = judge_signal(signal)
            if after is not signal:
                self.put(i, after.columns)
            yield from findings

    def pairs(self) -> Iterator[Finding]:
        """Of each position with its velocity."""
        for relation in integrals(self.model):
            if relation.i not in self.shown or relation.j not in self.shown:
                continue
            lag = lag_of(self.model, relation, self.trials)
            clear = lag if lag is not None and lag.coherence > ALIKE else None
            copied = relation.exact and differenced(self.model, relation, self.trials)
            if clear:
                yield from self.unit(relation, clear)
                yield from self.late(relation, clear)
            if relation.exact or clear:
                yield from self.constant(relation)
            over = clear.mean if clear and clear.mean >= SMOOTH * self.dt else copied * self.dt
            if relation.exact and over > 0:
                yield self.smoothed(relation, over)

        for relation, both in logged_behind(self.model, self.shown):  # how late is adopted
            lag, q = lag_of(self.model, relation, self.trials), self.model.state_names[relation.i]
            clear = lag if lag is not None and lag.coherence > ALIKE else None
            if clear and both and clear.filtered and clear.delay > 0:
                yield self.in_time(relation.j, clear, f"the derivative of {q}")
            elif clear and not clear.filtered and clear.mean >= SMOOTH * self.dt:
                yield self.smoothed(relation, clear.mean)

    def unit(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Sign and unit, which are put right; a scale, which may be either sensor's."""
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if lag.sign < 0 and self.turns_away(relation.i):
            text = f"turns the other way than {w} says and than the course that is travelled"
            yield self.turned_round(relation.i, text)
        elif lag.sign < 0:
            yield self.turned_round(relation.j, f"has the opposite sign of the rate of {q}")
        for i, factor in ((relation.j, lag.scale), (relation.i, 1 / lag.scale)):
            if abs(factor / DEGREES - 1) < UNIT:
                yield self.from_degrees(i)
                return
        if lag.off(OFF):
            yield scaled(w, q, lag.scale, self.model.states[w])
        elif relation.exact and lag.one_size:
            self.refuted |= {f"sensor_scale:{w}", f"sensor_scale:{q}", f"rate_gain:{q}"}

    def turns_away(self, i: int) -> bool:
        """Whether the course that is travelled agrees with a heading of the other sign."""
        plane = travelled(self.model, self.trials, self.shown)
        return plane is not None and plane[0].k == i and plane[1].agrees < AGREE < plane[1].mirrored

    def turned_round(self, i: int, text: str) -> Finding:
        """With the sign of state i changed."""
        self.put(i, [-x for x in self.column(i)])
        return put_right(self.model.state_names[i], text, "sign", "scale = -1", scale=-1.0)

    def from_degrees(self, i: int) -> Finding:
        """With state i in radians."""
        self.put(i, [x / DEGREES for x in self.column(i)])
        name = self.model.state_names[i]
        return in_degrees(name, self.model.states[name])

    def late(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """A delay that is not the model's own: no sensor is early, so it is the later one's."""
        d, least = float(abs(lag.delay)), max(LEAST_STEPS * self.dt, LEAST_S)
        own = own_lag(self.model, relation, self.trials) if relation.exact else 0.0
        beyond = max(min(own, 0.0) - lag.delay, lag.delay - max(own, 0.0))
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if beyond + SURE * lag.std < least:  # neither can be late alone by what counts
            self.in_step |= {q, w}
        if beyond < max(SURE * lag.std, least):
            return
        i, name, other = (relation.i, q, f"{w} says")
        if lag.delay > 0:
            i, name, other = (relation.j, w, f"the derivative of {q}")
        if i == relation.i and not relation.exact:  # a disturbed heading looks late as well
            yield Finding(name, f"{d:.3g} s later than {other}", "delay", d, lag.std)
        else:
            yield self.in_time(i, lag, other)

    def in_time(self, i: int, lag: Lag, other: str) -> Finding:
        """With state i as it was; what is filtered stays: moved, it is too small where it's quick.

        Args:
            i: the state.
            lag: how late it is, of either sign.
            other: what it is late behind, in words.
        """
        d, name = float(abs(lag.delay)), self.model.state_names[i]
        if lag.filtered:
            text = f"follows {other} through a filter of {d:.3g} s"
            return put_right(name, text, "lag", "", delay_s=d, std_s=lag.std)
        self.put(i, [earlier(x, d / self.dt) for x in self.column(i)])
        text, log = f"{d:.3g} s later than {other}", f"delay_s = {d:.3g}"
        return put_right(name, text, "delay", log, delay_s=d, std_s=lag.std)

    def smoothed(self, relation: Integral, over: float) -> Finding:
        """Without a velocity that is a mean over a time [s]: a difference of its position.

        It says no more than the position does, and where something stops it is wrong as long;
        moved back by half a step it is a mean over two, and an arm's delay was 1.7 ms off.
        """
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        self.put(relation.j, [np.full_like(x, np.nan) for x in self.column(relation.j)])
        self.shown.remove(relation.j)
        return a_mean(w, q, over)

    def positions(self) -> Iterator[Finding]:
        """Of both positions of a plane that are late together."""
        late = late_positions(self.model, self.trials, self.rows)
        if late is not None:
            for i in late.states:
                yield self.in_time(i, late.lag, "velocities and angles say")

    def constant(self, relation: Integral) -> Iterator[Finding]:
        """A constant between the two: of the velocity's sensor, or a drift of the position.

        Where there is none neither can be blamed: together they would cancel.
        """
        found = constant_of(self.model, relation, self.trials)
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if found is None:
            return
        if found.refuted:
            self.refuted |= {f"sensor_bias:{w}", f"offset:{q}"}
        elif found.found:
            unit, more = self.model.states[w], "more" if found.value > 0 else "less"
            text = f"shows {abs(found.value):.3g} {unit} {more} than the rate of {q} throughout"
            yield Finding(w, f"{text}; a sensor, or {q} drifts", "offset")

    def plane(self) -> Iterator[Finding]:
        """Of a heading and a speed with the way that was travelled."""
        plane = travelled(self.model, self.trials, self.shown)
        if plane is None:
            return
        relation, found = plane
        of = (self.model, relation.k, self.trials)
        where = "+".join(self.model.state_names[i] for i in (relation.i, relation.j))
        way = f"the course that {where} travel"
        if found.agrees < AGREE < found.mirrored:
            yield self.turned_round(relation.k, f"turns the other way than {way}")
        elif found.agrees < AGREE < found.degrees and not rate_agrees(*of):
            yield self.from_degrees(relation.k)
        elif found.agrees > AGREE and abs(found.offset) > TURNED_AWAY:
            text = f"is {np.rad2deg(-found.offset):.0f} degrees off {way}"
            yield Finding(self.model.state_names[relation.k], text, "offset")
        yield from judge_speed(self.model, relation, found.speed, self.dt)
