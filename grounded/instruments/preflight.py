"""START HERE: check sensors and commands from their signals, before any physics is identified.

single                    each state on its own
inputs                    copies of one another, at or beyond their limits, constant within a trial
units/odd_trial           a trial in other units than the rest
units/other_units         a position in mm beside a velocity in m/s
units/mismatch            a position that doesn't move as velocities and angles imply
kinematics/relations      velocities against the rates of positions, headings against courses
kinematics/velocities     a velocity that is dead, computed from its position, or biased
kinematics/swapped        two exchanged columns
kinematics/way            speeds in world axes or in knots, compass headings
kinematics/late_position  both positions of a plane later than velocities and heading
predictions/clocks        stamps at a wrong rate behind several scale errors
predictions/unresolved    a trial that becomes too fast for the model's time step
predictions/time_step     an integrator's step that is too long for the model

`sound_trials` adds those that need the model's predictions: exchanged states before these, other
units of positions, clocks, exchanged commands and signs of inputs after them.

Faults that are certain from the sensors alone are corrected in the trials passed on to the
diagnosis: a delayed signal is shifted, a wrong sign or unit undone, invalid samples become missing.
The filter of a sensor is passed on to the diagnosis' own filter (`Preflight.filters`). What physics
could cause as well, such as a scale error of a few percent or wheel slip, is only reported.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from grounded.frozen import Array
from grounded.instruments.finding import (
    A_SECOND,
    AS_LATE,
    DEGREES,
    RPM,
    Finding,
    Preflight,
    a_mean,
    derived_from,
    in_degrees,
    in_rpm,
    put_right,
    scaled,
)
from grounded.instruments.inputs import judge_inputs
from grounded.instruments.kinematics.late_position import late_positions
from grounded.instruments.kinematics.relations import (
    AGREE,
    OFF,
    TURNED_AWAY,
    differenced,
    judge_speed,
    lag_of,
    late_by_the_model,
    logged_behind,
    own_lag,
    travelled,
)
from grounded.instruments.kinematics.rows import kinematic_rows, tied
from grounded.instruments.kinematics.swapped import judge_columns
from grounded.instruments.kinematics.velocities import Derived, constant_of, derived, judge_dead
from grounded.instruments.kinematics.way import judge_way, rate_agrees
from grounded.instruments.lag import LEAST_S, SAME, SURE, SURELY, Lag, earlier
from grounded.instruments.predictions.clocks import told_by_the_clock
from grounded.instruments.predictions.time_step import judge_time_step
from grounded.instruments.predictions.unresolved import judge_resolution
from grounded.instruments.single import judge_signal, signal_of
from grounded.instruments.units.mismatch import (
    Mismatch,
    explained,
    stop_at,
    stop_at_folded,
    unexplained,
)
from grounded.instruments.units.odd_trial import (
    Odd,
    Ratios,
    all_in_degrees,
    odd_commands,
    odd_states,
    ratios_of,
)
from grounded.instruments.units.other_units import judge_stamps, judge_units
from grounded.model import Model
from grounded.places import Integral, integrals, partner, speed
from grounded.result import SMALL, with_error
from grounded.task import Task
from grounded.trial import Trial

LEAST_STEPS = 0.1  # of a time step: smaller delays may come from the time stamps
ALIKE = 0.9  # coherence above which two sensors are compared
ALIKE_RPM = 0.02  # relative tolerance within which it counts as that of rpm
UNIT = 0.1  # relative tolerance within which a scale counts as that of degrees
SMOOTH = 2.0  # time steps: a velocity averaged over less still resolves the motion


def preflight(
    subject: Task | Model,
    trials: Sequence[Trial],
    hidden: Sequence[str] = (),
    one_message: Sequence[str] = (),
) -> Preflight:
    """Check the sensors and commands of trials, and correct what is certain.

    Args:
        subject: the model, whose kinematics relate the sensors; a task adds the input limits.
        trials: real ones, of one time grid; unchanged if they don't fit the model.
        hidden: states without a sensor.
        one_message: states that are logged in one message, so that all or none of them are late.

    Raises:
        GroundedError: for logs that can't be used, with the correction.
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
            *bench.resolved(),
            *bench.singles(),
            *bench.with_message(bench.pairs(), one_message),
            *bench.with_message(bench.positions(), one_message),
            *bench.plane(),
            *unexplained(model, bench.trials, bench.rows),
            *judge_inputs(subject, bench.trials),
            *judge_time_step(model, bench.trials, bench.shown),
        ]
    in_step, refuted = frozenset(bench.in_step), frozenset(bench.refuted)
    found = told_by_the_clock(model, trials, found, refuted)
    return Preflight(tuple(found), tuple(bench.trials), in_step, refuted)


def _size(delay: float, lag: Lag) -> str:
    """Return a delay with its standard deviation, if that is known; in ms if that is small."""
    if not (np.isfinite(lag.std) and lag.std > 0):
        return f"{delay:.3g} s"
    if lag.std < SMALL:
        return f"{with_error(1e3 * delay, 1e3 * lag.std)} ms"
    return f"{delay:.3g} +- {lag.std:.2g} s"


class _Bench:
    """Trials that are corrected step by step, one finding after the other."""

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
        """Replace the samples of one state in all trials."""
        for k, (trial, x) in enumerate(zip(self.trials, columns, strict=True)):
            states = np.array(trial.states)
            states[:, i] = x
            self.trials[k] = replace(trial, states=states)

    def mismatched(self) -> Iterator[Finding]:
        """Correct signs and degrees by rows of several sensors.

        Raises:
            GroundedError: for other units and for exchanged columns.
        """
        found = explained(self.model, self.trials, self.rows, self.shown)
        stop_at(self.model, self.trials, found)
        if not found:
            stop_at_folded(self.model, self.trials, self.rows)
        for one in found:
            yield from self.without(one)

    def without(self, one: Mismatch) -> Iterator[Finding]:
        """Correct a sign or degrees, and yield the findings."""
        for k in one.trials:
            self.trials[k] = one.change.mended(self.trials[k])
        ids = [self.trials[k].id or f"number {k + 1}" for k in one.trials]
        where = f" in trial{'s' * (len(ids) > 1)} {', '.join(ids)}"
        where *= len(ids) < len(self.trials)
        for i in one.change.states:
            name = self.model.state_names[i]
            if one.change.factor > 0:
                unit = self.model.states[name]
                text = f"is in degrees{A_SECOND * unit.endswith('/s')}{where}, not in {unit}"
                log = f"scale = {1 / DEGREES:.8g}" * (not where)
                yield put_right(name, text, "degrees", log, scale=DEGREES)
            else:
                text = f"has the wrong sign{where}: with the other one positions fit velocities"
                yield put_right(name, text, "sign", "scale = -1" * (not where), scale=-1.0)

    def dead(self) -> Iterator[Finding]:
        """Remove the samples of dead velocity sensors."""
        for k, one in judge_dead(self.model, self.trials, self.shown):
            states = np.array(self.trials[k].states)
            states[:, one.relation.j] = np.nan
            where = f" in trial {self.trials[k].id or f'number {k + 1}'}"
            self.trials[k] = replace(self.trials[k], states=states)
            name = self.model.state_names[one.relation.j]
            yield Finding(name, one.told(self.model, where), "stuck", corrected=True)

    def odd(self, ratios: Sequence[Ratios]) -> Iterator[Finding]:
        """Convert trials that are in other units than the rest, as a whole or in one signal."""
        shown = [i for i in self.shown if all(np.isfinite(x).any() for x in self.column(i))]
        for odd in list(odd_states(self.model, self.trials, ratios, shown)):
            yield from self.in_unit(odd)
        for odd in all_in_degrees(self.model, self.trials, shown):
            self.trials[odd.trial] = odd.mended(self.trials[odd.trial])
            if odd.trial == 0:
                yield from (in_degrees(n, unit) for n, unit in self.named(odd))
        for odd in list(odd_commands(self.model, self.trials, shown)):
            yield from self.in_unit(odd)

    def resolved(self) -> Iterator[Finding]:
        """Cut trials where the model can't be integrated, if two steps or more are left."""
        for k, keep, finding in list(judge_resolution(self.model, self.trials, self.shown)):
            if keep >= 2:
                self.trials[k] = self.trials[k].until(keep)
                yield finding

    def in_unit(self, odd: Odd) -> Iterator[Finding]:
        """Convert one trial to the unit of the others; it concerns no key of [log]."""
        trial = self.trials[odd.trial]
        self.trials[odd.trial] = odd.mended(trial)
        where = f"in trial {trial.id or f'number {odd.trial + 1}'}"
        text = f"is in degrees {where}, in radians in the others"
        if abs(odd.factor / DEGREES - 1) > UNIT or odd.inputs:
            size = f"{max(odd.factor, 1 / odd.factor):.4g} times too"
            text = f"is {size} {'large' if odd.factor > 1 else 'small'} {where}"
        degrees = abs(abs(np.log(odd.factor)) - np.log(DEGREES)) < UNIT
        for name, _ in self.named(odd):
            kind = "degrees" if degrees else "scale"
            yield put_right(name, text, kind, "", scale=odd.factor)

    def named(self, odd: Odd) -> list[tuple[str, str]]:
        """Return names and units of the signals."""
        states, inputs = list(self.model.states.items()), list(self.model.inputs.items())
        return [states[i] for i in odd.states] + [inputs[j] for j in odd.inputs]

    def singles(self) -> Iterator[Finding]:
        """Check each sensor on its own."""
        for i in self.shown:
            signal = signal_of(self.model, self.trials, i, self.shown)
            findings, after = judge_signal(signal)
            if after is not signal:
                self.put(i, after.columns)
            yield from findings

    def pairs(self) -> Iterator[Finding]:
        """Check each position against its velocity."""
        modelled = {*late_by_the_model(self.model, self.shown).values()}
        for relation in integrals(self.model):
            if relation.i not in self.shown or relation.j not in self.shown:
                continue
            lag = lag_of(self.model, relation, self.trials)
            clear = lag if lag is not None and lag.coherence > ALIKE else None
            if clear and (found := self.derived(relation, clear)):
                yield from self.late(relation, clear)
                yield self.filtered(relation, found)
                continue
            copied = relation.exact and differenced(self.model, relation, self.trials)
            if clear:
                yield from self.unit(relation, clear)
                if modelled.isdisjoint((relation.i, relation.j)):
                    yield from self.late(relation, clear)
            if relation.exact or clear:
                yield from self.constant(relation)
            over = clear.mean if clear and clear.mean >= SMOOTH * self.dt else copied * self.dt
            if relation.exact and over > 0:
                yield self.smoothed(relation, over)

        for relation, both in logged_behind(self.model, self.shown):  # their delay is adopted
            lag, q = lag_of(self.model, relation, self.trials), self.model.state_names[relation.i]
            clear = lag if lag is not None and lag.coherence > ALIKE else None
            if clear and (found := self.derived(relation, clear)):
                yield self.filtered(relation, found)
            elif clear and both and clear.filtered and clear.delay > 0:
                yield self.in_time(relation.j, clear, f"the derivative of {q}")
            elif clear and not clear.filtered and clear.mean >= SMOOTH * self.dt:
                yield self.smoothed(relation, clear.mean)

    def with_message(self, findings: Iterator[Finding], names: Sequence[str]) -> Iterator[Finding]:
        """Correct all states of a message by the delay of one of them, the most certain one."""
        found = list(findings)
        yield from found
        late = [f for f in found if f.kind == "delay" and f.corrected and f.signal in names]
        if not late or self.in_step & {*names}:
            return
        one = min(late, key=lambda f: f.std_s)
        for i in self.shown:
            name = self.model.state_names[i]
            if name in names and name not in {f.signal for f in late}:
                self.put(i, [earlier(x, one.delay_s / self.dt) for x in self.column(i)])
                yield replace(one, signal=name, finding=f"{AS_LATE} {one.signal}")

    def unit(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Correct sign and unit; report a scale, which may be that of either sensor."""
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if lag.sign < 0 and self.turns_away(relation.i):
            text = f"turns in the opposite direction to {w} and to the course travelled"
            yield self.turned_round(relation.i, text)
        elif lag.sign < 0:
            yield self.turned_round(relation.j, f"has the opposite sign of the rate of {q}")
        for i, factor in ((relation.j, lag.scale), (relation.i, 1 / lag.scale)):
            if abs(factor / DEGREES - 1) < UNIT:
                yield self.from_degrees(i)
                return
        if self.model.states[w] == "rad/s" and abs(lag.scale / RPM - 1) < ALIKE_RPM:
            self.put(relation.j, [x / RPM for x in self.column(relation.j)])
            yield in_rpm(w)
        elif lag.off(OFF):
            yield scaled(w, q, lag.scale, self.model.states[w])
        elif relation.exact and lag.one_size:
            self.refuted |= {f"sensor_scale:{w}", f"sensor_scale:{q}"}
            self.refuted |= self.of_position("rate_gain", q, w)

    def turns_away(self, i: int) -> bool:
        """Check whether the course travelled agrees with the heading only if its sign reverses."""
        plane = travelled(self.model, self.trials, self.shown)
        return plane is not None and plane[0].k == i and plane[1].agrees < AGREE < plane[1].mirrored

    def turned_round(self, i: int, text: str) -> Finding:
        """Reverse the sign of state i."""
        self.put(i, [-x for x in self.column(i)])
        return put_right(self.model.state_names[i], text, "sign", "scale = -1", scale=-1.0)

    def from_degrees(self, i: int) -> Finding:
        """Convert state i from degrees to radians."""
        self.put(i, [x / DEGREES for x in self.column(i)])
        name = self.model.state_names[i]
        return in_degrees(name, self.model.states[name])

    def late(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Correct a delay beyond the model's own; the later sensor has it, since none is early."""
        d, least = float(abs(lag.delay)), max(LEAST_STEPS * self.dt, LEAST_S)
        own = own_lag(self.model, relation, self.trials) if relation.exact else 0.0
        beyond = max(min(own, 0.0) - lag.delay, lag.delay - max(own, 0.0))
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if beyond + SURE * lag.std < least:  # neither can have a relevant delay of its own
            self.in_step |= {q, w}
        if beyond < max(SURE * lag.std, least):
            return
        i, name, other = (relation.i, q, f"{w} says")
        if lag.delay > 0:
            i, name, other = (relation.j, w, f"the derivative of {q}")
        if i == relation.i and not relation.exact:  # a disturbed heading also looks late
            yield Finding(name, f"{_size(d, lag)} later than {other}", "delay", d, lag.std)
        else:
            yield self.in_time(i, lag, other)

    def in_time(self, i: int, lag: Lag, other: str) -> Finding:
        """Undo the delay of state i. A filtered state is only reported: a shift can't restore it.

        Args:
            i: the state.
            lag: its delay, of either sign.
            other: what it lags behind, in words.
        """
        d, name = float(abs(lag.delay)), self.model.state_names[i]
        if lag.filtered:
            text = f"follows {other} through a filter of {d:.3g} s"
            return put_right(name, text, "lag", "", delay_s=d, std_s=lag.std)
        self.put(i, [earlier(x, d / self.dt) for x in self.column(i)])
        text, log = f"{_size(d, lag)} later than {other}", f"delay_s = {d:.3g}"
        return put_right(name, text, "delay", log, delay_s=d, std_s=lag.std)

    def smoothed(self, relation: Integral, over: float) -> Finding:
        """Drop a velocity that is a mean over a time [s], as a difference of its position is.

        It adds nothing to the position, and around a stop it is wrong for that time. Shifted back
        by half a step it becomes a mean over two, which made an arm's delay wrong by 1.7 ms.
        """
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        self.put(relation.j, [np.full_like(x, np.nan) for x in self.column(relation.j)])
        self.shown.remove(relation.j)
        return a_mean(w, q, over)

    def derived(self, relation: Integral, lag: Lag) -> Derived | None:
        """Return how a late velocity, no plain mean, follows from its position, if it does."""
        mean = lag.mean >= SMOOTH * self.dt
        if mean or not relation.exact or lag.sign < 0 or lag.delay < 0.5 * self.dt:
            return None  # a difference over one step is half a step late
        return derived(self.model, relation, self.trials, self.dt)

    def filtered(self, relation: Integral, found: Derived) -> Finding:
        """Drop a velocity that a filter computes from its position: neither is a delay or scale."""
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if abs(found.gain - 1) + SURELY * found.gain_std < SAME:
            self.refuted |= {f"sensor_scale:{w}", f"sensor_scale:{q}"}
            self.refuted |= self.of_position("rate_gain", q, w)
        return replace(self.smoothed(relation, found.over), finding=derived_from(q, found.age))

    def positions(self) -> Iterator[Finding]:
        """Correct both positions of a plane that share a delay."""
        late = late_positions(self.model, self.trials, self.rows)
        if late is not None:
            for i in late.states:
                yield self.in_time(i, late.lag, "the motion by velocities and angles")

    def constant(self, relation: Integral) -> Iterator[Finding]:
        """Report a constant bias: of the velocity's sensor, or a drift of the position.

        If there is none, both causes are ruled out, since only together could they cancel.
        """
        found = constant_of(self.model, relation, self.trials)
        q, w = (self.model.state_names[k] for k in (relation.i, relation.j))
        if found is None:
            return
        if found.refuted:
            self.refuted |= {f"sensor_bias:{w}"} | self.of_position("offset", q, w)
        elif found.found:
            unit, v = self.model.states[w], speed(self.model)
            more = "more" if (found.pull or found.value) > 0 else "less"
            text = f"shows {abs(found.value):.3g} {unit} {more} than the rate of {q} throughout"
            why = f"a sensor bias, or {q} drifts"
            if found.pull and v:
                size = f"{abs(found.pull):.3g} {unit} per {self.model.states[v]} of {v}"
                text = f"shows {size} {more} than the rate of {q}"
                why = "wheels of unequal size, or a pull to one side"
            yield Finding(w, f"{text}: {why}", "offset")

    def of_position(self, family: str, q: str, w: str) -> set[str]:
        """Return an effect on the rate of q that a sensor of w without it rules out, if any.

        A heading rate that is only carried along shows what turns the robot, effects included.
        """
        return set() if partner(self.model, q) == w else {f"{family}:{q}"}

    def plane(self) -> Iterator[Finding]:
        """Check a heading and a speed against the course travelled."""
        plane = travelled(self.model, self.trials, self.shown)
        if plane is None:
            return
        relation, found = plane
        of = (self.model, relation.k, self.trials)
        where = "+".join(self.model.state_names[i] for i in (relation.i, relation.j))
        way = f"the course given by {where}"
        if found.agrees < AGREE < found.mirrored:
            yield self.turned_round(relation.k, f"turns in the opposite direction to {way}")
        elif found.agrees < AGREE < found.degrees and not rate_agrees(*of):
            yield self.from_degrees(relation.k)
        elif found.agrees > AGREE and abs(found.offset) > TURNED_AWAY:
            text = f"is {np.rad2deg(-found.offset):.0f} degrees off {way}"
            yield Finding(self.model.state_names[relation.k], text, "offset")
        yield from judge_speed(self.model, relation, found.speed, self.dt)
