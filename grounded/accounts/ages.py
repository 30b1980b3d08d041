"""How old the samples of a sensor are: late, filtered, computed from a position, or biased.

Each velocity is compared with the rate of its position, and both positions of a plane with the
motion by speeds and heading, by `lag`. A delay or filter that is certain is undone; what physics
could cause as well, such as a scale error of a few percent or a drift, is reported. A velocity that
a program computes from its position adds nothing to it, and is left out:

    w_k = sum_i b_i (q_{k-i} - q_{k-i-1}) / dt      b fitted, sum b = 1, none of the future

Such a velocity carries the position's noise exactly, whereas one from a sensor of its own, however
late, leaves at least that as a remainder. A constant bias is fitted over stretches of all trials,
beside a scale: the mean of c w less the distance over the time is c b + k times the latter.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from grounded.accounts.finding import (
    Finding,
    a_mean,
    derived_from,
    put_right,
    scaled,
)
from grounded.accounts.kinematics import (
    Row,
    kinematic_rows,
    per_step,
    pieces,
    turned,
)
from grounded.accounts.lag import (
    COHERENT,
    LEAST_S,
    REPORTED_FROM,
    SAME,
    SURELY,
    Lag,
    at_samples,
    earlier,
    lag_between,
)
from grounded.accounts.signals import quantum
from grounded.findings import Quantity
from grounded.findings import found as found_
from grounded.frozen import Array, median, white_noise, wrapped
from grounded.model import Model
from grounded.places import Integral, integrals, partner, true_values
from grounded.result import PREFIX_BELOW
from grounded.trial import Trial

LEAST_STEPS = 0.1  # of a time step: smaller delays may come from the time stamps
SMOOTH = 2.0  # time steps: a velocity averaged over less still resolves the motion
OFF = 0.03  # scale error that is reported, beyond both of its bounds
OWN = 200  # logged samples from which the model's own lag is computed
PASTS, LATER = (24, 12, 6, 3), 2  # differences before and after the sample that get a weight
SAMPLES_PER_WEIGHT = 10  # samples per weight
FORESEEN = 0.1  # weight of the second later difference above which it is no causal filter
CARRIED = 0.75  # of the noise that the weights take from the position: more is another's
UNEXPLAINED = 0.2  # of the velocity's size: a larger remainder comes from another sensor
STRETCHES, SHORTEST = 24, 4  # least number of stretches for a bias, and steps in one
FINE = 0.02  # of the rms: so small a bias would have been seen
AS_LATE = 0.15  # of a delay, or AGREE standard deviations: two positions are as late
AGREE, UNSURE = 2.5, 0.25  # standard deviations; and of a delay: larger ones show none
SMOOTH_S = 0.3  # [s] half the window over which a path is smoothed


class Ages:
    """Trials whose sensors are put in time step by step, one finding after the other.

    Args:
        model: however crude.
        trials: in the model's units.
        shown: indices of the states with a sensor.
    """

    def __init__(self, model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> None:
        self.model, self.trials, self.shown = model, list(trials), list(shown)
        self.in_step, self.refuted = set[str](), set[str]()
        self.dt, self.names = self.trials[0].dt, model.state_names

    def findings(self, one_message: Sequence[str]) -> list[Finding]:
        """Correct the trials; return what was found.

        Args:
            one_message: states that are logged in one message: all of them are late, or none.
        """
        found = [
            *self.with_message(self.pairs(), one_message),
            *self.with_message(self.positions(), one_message),
        ]
        return found

    def put(self, i: int, columns: Sequence[Array]) -> None:
        """Replace the samples of one state in all trials."""
        for k, (trial, x) in enumerate(zip(self.trials, columns, strict=True)):
            states = np.array(trial.states)
            states[:, i] = x
            self.trials[k] = replace(trial, states=states)

    def column(self, i: int) -> list[Array]:
        """Return the samples of one state in all trials."""
        return [trial.states[:, i] for trial in self.trials]

    def pairs(self) -> Iterator[Finding]:
        """Compare each velocity with its position."""
        log = true_values(self.names, [n for i, n in enumerate(self.names) if i not in self.shown])
        for relation in integrals(self.model):
            if not {relation.i, relation.j} <= {*self.shown}:
                continue
            clear = self.clear(relation)
            if clear and (found := self.derived(relation, clear)):
                yield from self.late(relation, clear)
                yield self.filtered(relation, found)
                continue
            if clear:
                yield from self.scale(relation, clear)
                if {*log.values()}.isdisjoint((relation.i, relation.j)):
                    yield from self.late(relation, clear)
            if relation.exact or clear:
                yield from self.constant(relation)
            if relation.exact and clear and clear.mean >= SMOOTH * self.dt:
                yield self.smoothed(relation, clear.mean)
        # states whose delay was adopted: their true values are the model's memory
        for one in integrals(self.model):
            relation = replace(one, i=log.get(one.i, one.i), j=log.get(one.j, one.j))
            if not one.exact or {one.i, one.j}.isdisjoint(log):
                continue
            if not {relation.i, relation.j} <= {*self.shown} or not (clear := self.clear(relation)):
                continue
            if found := self.derived(relation, clear):
                yield self.filtered(relation, found)
            elif {one.i, one.j} <= {*log} and clear.filtered and clear.delay > 0:
                yield self.in_time(relation.j, clear, self.names[relation.i], rate=True)
            elif not clear.filtered and clear.mean >= SMOOTH * self.dt:
                yield self.smoothed(relation, clear.mean)

    def clear(self, relation: Integral) -> Lag | None:
        """Return the lag of a velocity behind the rate of its position; None if they differ."""
        lag = lag_of(self.model, relation, self.trials)
        return lag if lag is not None and lag.coherence > COHERENT else None

    def with_message(self, findings: Iterator[Finding], names: Sequence[str]) -> Iterator[Finding]:
        """Correct all states of a message by the delay of one of them, the most certain one."""
        found = list(findings)
        yield from found
        late = [f for f in found if f.kind == "delay" and f.corrected and f.signal in names]
        if not late or self.in_step & {*names}:
            return
        one = min(late, key=lambda f: f.std_s)
        for i in self.shown:
            name = self.names[i]
            if name in names and name not in {f.signal for f in late}:
                self.put(i, [earlier(x, one.delay_s / self.dt) for x in self.column(i)])
                said = found_("sensor.late", name, message=one.signal)
                yield replace(one, signal=name, said=said)

    def scale(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Report a scale, which may be that of either sensor; equal ones rule effects out."""
        q, w = (self.names[k] for k in (relation.i, relation.j))
        if lag.off(OFF):
            yield scaled(w, q, lag.scale, self.model.states[w])
        elif relation.exact and lag.one_size:
            self.rule_out(q, w)

    def rule_out(self, q: str, w: str) -> None:
        """Note that neither sensor of a position and its velocity has a scale error."""
        self.refuted |= {f"sensor_scale:{w}", f"sensor_scale:{q}"}
        self.refuted |= self.of_position("rate_gain", q, w)

    def of_position(self, family: str, q: str, w: str) -> set[str]:
        """Return an effect on the rate of q that a sensor of w without it rules out, if any.

        A heading rate that is only carried along shows what turns the robot, effects included.
        """
        return set() if partner(self.model, q) == w else {f"{family}:{q}"}

    def late(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Correct a delay beyond the model's own; the later sensor has it, since none is early."""
        d, least = float(abs(lag.delay)), max(LEAST_STEPS * self.dt, LEAST_S)
        own = own_lag(self.model, relation, self.trials) if relation.exact else 0.0
        beyond = max(min(own, 0.0) - lag.delay, lag.delay - max(own, 0.0))
        q, w = (self.names[k] for k in (relation.i, relation.j))
        if beyond + REPORTED_FROM * lag.std < least:  # neither can have a relevant delay of its own
            self.in_step |= {q, w}
        if beyond < max(REPORTED_FROM * lag.std, least):
            return
        if lag.delay > 0:
            yield self.in_time(relation.j, lag, q, rate=True)
        elif relation.exact:
            yield self.in_time(relation.i, lag, w)
        else:  # a disturbed heading also looks late
            yield Finding(q, found_("sensor.late", q, by=_size(d, lag), of=w), "delay", d, lag.std)

    def in_time(self, i: int, lag: Lag, of: str, *, rate: bool = False) -> Finding:
        """Undo the delay of state i. A filtered state is only reported: a shift can't restore it.

        Args:
            i: the state.
            lag: its delay, of either sign.
            of: what it lags behind.
            rate: whether it lags behind the derivative of that.
        """
        d, name = float(abs(lag.delay)), self.names[i]
        if lag.filtered:
            said = found_("sensor.late", name, tau=d, of=of, derivative=rate)
            return put_right(name, said, "lag", {}, delay_s=d, std_s=lag.std)
        self.put(i, [earlier(x, d / self.dt) for x in self.column(i)])
        said = found_("sensor.late", name, by=_size(d, lag), of=of, derivative=rate)
        keys = {"delay_s": float(f"{d:.3g}")}
        return put_right(name, said, "delay", keys, delay_s=d, std_s=lag.std)

    def smoothed(self, relation: Integral, over: float) -> Finding:
        """Drop a velocity that is a mean over a time [s], as a difference of its position is.

        It adds nothing to the position, and around a stop it is wrong for that time.
        """
        q, w = (self.names[k] for k in (relation.i, relation.j))
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
        q, w = (self.names[k] for k in (relation.i, relation.j))
        if abs(found.gain - 1) + SURELY * found.gain_std < SAME:
            self.rule_out(q, w)
        return replace(self.smoothed(relation, found.over), said=derived_from(w, q, found.age))

    def constant(self, relation: Integral) -> Iterator[Finding]:
        """Report a constant bias: of the velocity's sensor, or a drift of the position.

        If there is none, both causes are ruled out, since only together could they cancel.
        """
        found = bias_of(self.model, relation, self.trials)
        q, w = (self.names[k] for k in (relation.i, relation.j))
        if found is None:
            return
        if found.refuted:
            self.refuted |= {f"sensor_bias:{w}"} | self.of_position("offset", q, w)
        elif found.found:
            size = Quantity(abs(found.value), self.model.states[w])
            way = "more" if found.value > 0 else "less"
            yield Finding(w, found_("sensor.scale", w, size=size, way=way, of=q), "offset")

    def positions(self) -> Iterator[Finding]:
        """Correct both positions of a plane that share a delay."""
        rows, plane = kinematic_rows(self.model, self.shown), turned(self.model)
        both = [row for row in rows if plane and row.i in (plane.i, plane.j)]
        if len(both) == 2 and (lag := late_positions(self.model, self.trials, both)):
            for row in both:
                yield self.in_time(row.i, lag, "the motion")


def _size(delay: float, lag: Lag) -> Quantity:
    """Return a delay with its standard deviation; in ms if that is small."""
    if lag.std < PREFIX_BELOW:
        return Quantity(1e3 * delay, "ms", 1e3 * lag.std)
    return Quantity(delay, "s", lag.std)


# --- a velocity and its position ------------------------------------------------------------------


def _rates(
    model: Model, relation: Integral, trials: Sequence[Trial]
) -> Iterator[tuple[Array, Array, Array]]:
    """Yield the pieces (T, 2) with the position's steps (T - 1,) and the velocity c w (T,)."""
    for piece in pieces(trials, (relation.i, relation.j)):
        moved = wrapped(np.diff(piece[:, :1], axis=0), [model.angle_mask[relation.i]])
        yield piece, moved[:, 0], relation.c * piece[:, 1]


def lag_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Lag | None:
    """Return delay and scale of a logged velocity against the rate of its logged position."""
    dt = trials[0].dt
    some = [
        (moved[1:-1] / dt, (13 * (w[1:-2] + w[2:-1]) - w[:-3] - w[3:]) / 24)  # means over steps
        for _, moved, w in _rates(model, relation, trials)
    ]
    return lag_between(some, dt)


def own_lag(model: Model, relation: Integral, trials: Sequence[Trial]) -> float:
    """Return the delay of a velocity behind its position's rate in the model itself [s].

    It is evaluated at logged samples. A simulator that moves a position by the velocity before or
    after a step has a lag of half a step, which is not a sensor's.
    """
    dt, (i, j, c) = trials[0].dt, (relation.i, relation.j, relation.c)
    x = np.concatenate([trial.states[:-1] for trial in trials])
    u = np.concatenate([trial.inputs for trial in trials])
    known = np.isfinite(x[:, [i, j]]).all(axis=1) & np.isfinite(u).all(axis=1)
    at = np.flatnonzero(known)[:: max(1, int(known.sum()) // OWN)]
    if not len(at):
        return 0.0
    before = np.nan_to_num(x[at], nan=0.0)  # states without a sensor
    after = model.system.step(before, u[at], model.values, dt)
    changed = c * (after[:, j] - before[:, j])
    moved = model.difference(after, before)[:, i] / dt - c * (after[:, j] + before[:, j]) / 2
    size = float(changed @ changed)
    late = float(moved @ changed) / size * dt if size > 0 else 0.0
    return late if np.isfinite(late) and abs(late) < dt else 0.0


@dataclass(frozen=True)
class Derived:
    """The weights of past differences of a position in a velocity, summarised.

    Args:
        gain: their sum.
        gain_std: its standard deviation.
        age: their mean age [s].
        over: length of the plain mean with the same variance of ages [s].
    """

    gain: float
    gain_std: float
    age: float
    over: float


def derived(
    model: Model, relation: Integral, trials: Sequence[Trial], least: float
) -> Derived | None:
    """Return how a velocity follows from its position through a causal filter.

    Args:
        model: with this relation.
        relation: the position and the velocity.
        trials: of this model's states.
        least: time over which it must certainly average [s].

    Returns:
        None if it has another scale, is not explained by the position's past, or averages less.
    """
    dt, logs = trials[0].dt, list[tuple[Array, Array, Array]]()
    counts = quantum([piece[:, 0] for piece in pieces(trials, (relation.i, relation.j))])
    for _, moved, w in _rates(model, relation, trials):
        way = np.concatenate([[0.0], np.cumsum(moved)])
        logs.append((moved / dt, w, white_noise(way[:, None])))
    floor = counts / np.sqrt(12)  # of an encoder, at rest on one count mostly
    tried = (_weighed(logs, dt, least, past, floor) for past in PASTS)
    return next((found for found in tried if found is not None), None)


def _weighed(
    logs: Sequence[tuple[Array, Array, Array]], dt: float, least: float, past: int, floor: float
) -> Derived | None:
    """Return the same from the weights of `past` differences; `floor`: least noise of a log."""
    rows, said, seen = list[Array](), list[Array](), list[Array]()
    for rate, velocity, own in logs:
        if len(rate) >= past + LATER:
            windows = np.lib.stride_tricks.sliding_window_view(rate, past + LATER)
            rows.append(windows[:, ::-1])
            said.append(velocity[past : past + len(windows)])
            seen.append(own)
    count = sum(map(len, said))
    if count < SAMPLES_PER_WEIGHT * (past + LATER):
        return None
    a, w = np.concatenate(rows), np.concatenate(said)
    weights, _, rank, _ = np.linalg.lstsq(a, w, rcond=None)
    rest = w - a @ weights
    if rank < a.shape[1] or not float(rest @ rest) < UNEXPLAINED**2 * float(w @ w):
        return None
    # the velocity must carry the position's noise as its weights would
    noise = max(float(median(np.concatenate(seen))), floor)
    passed = noise * float(np.linalg.norm(np.diff(np.pad(weights, 1)))) / dt
    if not np.sqrt(rest @ rest / count) < CARRIED * passed:
        return None
    covariance = np.linalg.inv(a.T @ a) * float(rest @ rest) / count
    gain = float(weights.sum())
    if abs(gain - 1) > OFF or abs(float(weights[0])) > FORESEEN:
        return None
    ages = (np.arange(past + LATER) - LATER + 0.5) * dt
    age = float(weights @ ages) / gain
    apart = (ages - age) ** 2 + dt**2 / 12  # each difference is itself a mean over a step
    wide = 12 * float(weights @ apart)
    std = 12 * float(np.sqrt(apart @ covariance @ apart))
    if wide - SURELY * std < least**2:
        return None
    return Derived(gain, float(np.sqrt(covariance.sum())), age, float(np.sqrt(wide)))


@dataclass(frozen=True)
class Bias:
    """The bias of a logged velocity against the rate of its position.

    Args:
        value: the bias, in the velocity's unit; positive if the velocity is too large.
        std: its standard deviation.
        rms: rms of the velocity itself.
    """

    value: float
    std: float
    rms: float

    @property
    def found(self) -> bool:
        """Whether the bias is significant and large enough to report."""
        return abs(self.value) > max(REPORTED_FROM * self.std, SAME * self.rms)

    @property
    def refuted(self) -> bool:
        """Whether the trials rule a bias out: none is seen, and one would have been."""
        return abs(self.value) < SURELY * self.std and REPORTED_FROM * self.std < FINE * self.rms


def bias_of(model: Model, relation: Integral, trials: Sequence[Trial]) -> Bias | None:
    """Return the bias of a logged velocity against its position; None with too little data.

    It is fitted over stretches, beside a scale: the velocity's mean less the position's rate.
    """
    dt, whole = trials[0].dt, list(_rates(model, relation, trials))
    steps, rows = sum(len(moved) for _, moved, _ in whole), list[tuple[float, float, float]]()
    for _, moved, w in whole:
        rate, off = moved / dt, 0.5 * (w[1:] + w[:-1]) - moved / dt
        parts = max(1, min(-(-STRETCHES * len(rate) // steps), len(rate) // SHORTEST))
        for some in np.array_split(np.arange(len(rate)), parts):
            rows.append((float(off[some].mean()), float(rate[some].mean()), float(len(some))))
    if len(rows) < STRETCHES // 2:
        return None
    off, rates, counts = np.array(rows).T
    design = np.stack([np.ones_like(rates), rates], axis=1)
    inverse = np.linalg.pinv(design.T @ (counts[:, None] * design), hermitian=True)
    fitted = inverse @ (design.T @ (counts * off))
    left = float(counts @ (off - design @ fitted) ** 2)
    std = (left / (len(rows) - 2) * float(inverse[0, 0])) ** 0.5
    every = np.concatenate([w for *_, w in whole])
    rms = float(np.sqrt((every**2).mean())) / abs(relation.c)
    return Bias(float(fitted[0]) / relation.c, std / abs(relation.c), rms)


# --- a plane --------------------------------------------------------------------------------------


def late_positions(model: Model, trials: Sequence[Trial], both: Sequence[Row]) -> Lag | None:
    """Return the delay that both positions of a plane share behind velocities and heading, or None.

    The velocity S of a position that is late by d is off by -d S'. A slipping wheel acts along the
    path as well, a side slip or a tracked point ahead across it, a drift by a constant: the delay
    is estimated beside these, and none may remain of it. If the sideways velocity is not measured,
    it must show both along and across the path; and on each position on its own.

    Args:
        model: however crude.
        trials: of one time step, already corrected for other faults.
        both: the rows of the two positions.
    """
    dt, columns, units = trials[0].dt, [row.i for row in both], list(model.states.values())
    ways = [(z[:, columns], s[:, columns]) for t in trials for z, s in per_step(model, t, both)]
    every, *each = (
        lag_between([(said[:, k], moved[:, k]) for k in some for moved, said in ways], dt)
        for some in ((0, 1), (0,), (1,))
    )
    if every is None or every.sign < 0 or every.coherence < COHERENT:
        return None
    if every.delay < max(REPORTED_FROM * every.std, 0.5 * dt):
        return None
    one, other = each
    if one is not None and other is not None:
        sure = AGREE * float(np.hypot(one.std, other.std))
        if abs(one.delay - other.delay) > max(sure, AS_LATE * every.delay):
            return None
    apart = len({j for row in both for j in row.by if units[j].endswith("/s")}) < 2
    if any(std > UNSURE * late for late, std in _left(ways, 0.0, dt, apart=apart)):
        return None  # beside a drift nothing shows it
    for left, std in _left(ways, every.delay / dt, dt, apart=apart):
        if std > UNSURE * every.delay or abs(left) > max(AGREE * std, AS_LATE * every.delay):
            return None
    return every


def _left(
    ways: Sequence[tuple[Array, Array]], steps: float, dt: float, *, apart: bool
) -> list[tuple[float, float]]:
    """Return the delay [s] that remains after shifting positions, with its standard deviation.

    Args:
        ways: displacements of each piece, measured and by the other sensors (T, 2).
        steps: by which the positions are shifted earlier.
        dt: time step [s].
        apart: estimate the delay along the path and across it separately.
    """
    h = max(3, round(SMOOTH_S / dt))
    window = np.hanning(2 * h + 3)[1:-1]
    window /= window.sum()
    rests, designs = [np.empty(0)], [np.empty((0, 6 if apart else 5))]
    for moved, said in ways:
        at = np.arange(len(moved)) + steps
        early = np.stack([at_samples(moved[:, k], at) for k in (0, 1)], axis=1)
        known = np.isfinite(early).all(axis=1)
        if known.sum() < 3 * len(window):
            continue
        z, s = (
            np.stack([np.convolve(one[known][:, k], window, "valid") for k in (0, 1)], axis=1) / dt
            for one in (early, said)
        )
        # a late position, beside slip along and across the path and a point ahead or aside
        slope, size = np.gradient(s, dt, axis=0), np.maximum(np.hypot(*s.T), 1e-9)[:, None]
        ahead = s / size
        side = np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)
        along = (slope * ahead).sum(axis=1, keepdims=True) * ahead
        turn = (slope * side).sum(axis=1, keepdims=True) / size
        late = [along, slope - along] if apart else [slope]
        design = np.stack(
            [*(-one for one in late), turn * side, -turn * ahead, ahead, side], axis=2
        )
        for k in (0, 1):
            rests.append((z - s)[:, k] - (z - s)[:, k].mean())
            designs.append(design[:, k] - design[:, k].mean(axis=0))
    rest, design = np.concatenate(rests), np.concatenate(designs)
    if len(rest) < 16 or np.linalg.matrix_rank(design) < design.shape[1]:
        return [(0.0, np.inf)]
    spread = np.linalg.inv(design.T @ design)
    found = spread @ design.T @ rest
    forces = design * (rest - design @ found)[:, None]
    parts = np.stack([part.sum(axis=0) for part in np.array_split(forces, 32)])
    stds = np.sqrt(np.diag(spread @ parts.T @ parts @ spread))
    return [(float(found[k]), float(stds[k])) for k in range(1 + apart)]
