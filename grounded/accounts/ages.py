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
from dataclasses import replace
from typing import Any

import numpy as np

from grounded.accounts.finding import Finding
from grounded.accounts.kinematics import Row, kinematic_rows, per_step, pieces, turned
from grounded.accounts.lag import (
    Lag,
    at_samples,
    earlier,
    lag_between,
)
from grounded.accounts.levels import (
    FEWEST_SAMPLES,
    GROSS,
    NEARLY_ALL,
    PART,
    REPORTED_FROM,
    SLIGHT,
    SURELY,
)
from grounded.accounts.signals import quantum
from grounded.findings import Quantity
from grounded.findings import found as found_
from grounded.frozen import Array, white_noise, wrapped
from grounded.model import Model
from grounded.places import Integral, integrals, partner, true_values
from grounded.result import PREFIX_BELOW
from grounded.trial import Trial
from grounded.units import RPM

LEAST_STEPS = 0.1  # of a time step: smaller delays may come from the time stamps
OFF = 0.03  # scale error that is reported, beyond both of its bounds
OWN = 200  # logged samples from which the model's own lag is computed
PAST, LATER = 24, 2  # differences before and after the sample that get a weight
SHORTEST = 4  # steps in a stretch for a bias
SMOOTH_S = 0.3  # [s] half the window over which a path is smoothed


class Ages:
    """Trials whose sensors are put in time step by step, one finding after the other."""

    def __init__(self, model: Model, trials: Sequence[Trial], shown: Sequence[int]) -> None:
        self.model, self.trials, self.shown = model, list(trials), list(shown)
        self.in_step, self.refuted = set[str](), set[str]()
        self.dt, self.names = self.trials[0].dt, model.state_names

    def findings(self, one_message: Sequence[str]) -> list[Finding]:
        """Correct the trials; of states in one message all are late, or none."""
        some = (self.pairs, self.positions)
        return [one for each in some for one in self.with_message(list(each()), one_message)]

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
        """Compare each velocity with its position; both may be the true ones behind late logs."""
        hidden = [name for i, name in enumerate(self.names) if i not in self.shown]
        log = true_values(self.names, hidden)
        for one in integrals(self.model):
            relation = replace(one, i=log.get(one.i, one.i), j=log.get(one.j, one.j))
            pair, adopted = {relation.i, relation.j}, not {one.i, one.j}.isdisjoint(log)
            if not pair <= {*self.shown} or (adopted and not one.exact):
                continue
            lag = lag_of(self.model, relation, self.trials)
            clear = lag if lag is not None and lag.coherence > NEARLY_ALL else None
            # a difference over one step is half a step late
            behind = clear and relation.exact and clear.sign > 0 and clear.delay >= self.dt / 2
            if clear and behind and (found := derived(self.model, relation, self.trials, self.dt)):
                if not adopted:
                    yield from self.late(relation, clear)
                yield self.filtered(relation, found)
            elif adopted:
                if clear and {one.i, one.j} <= {*log} and clear.filtered and clear.delay > 0:
                    yield self.in_time(relation.j, clear, self.names[relation.i], rate=True)
            else:
                if clear:
                    yield from self.scale(relation, clear)
                    if pair.isdisjoint(log.values()):
                        yield from self.late(relation, clear)
                if relation.exact or clear:
                    yield from self.constant(relation)

    def with_message(self, found: Sequence[Finding], names: Sequence[str]) -> Iterator[Finding]:
        """Correct all states of a message by the delay of one of them, the most certain one."""
        yield from found
        late = [f for f in found if f.kind == "delay" and f.corrected and f.signal in names]
        if not late or self.in_step & {*names}:
            return
        one = min(late, key=lambda f: f.std_s)
        others = {*names} - {f.signal for f in late}
        for i in (i for i in self.shown if self.names[i] in others):
            self.put(i, [earlier(x, one.delay_s / self.dt) for x in self.column(i)])
            said = found_("sensor.late", self.names[i], message=one.signal)
            yield replace(one, signal=self.names[i], said=said)

    def scale(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Report a scale, which may be that of either sensor; equal ones rule effects out."""
        q, w = (self.names[k] for k in (relation.i, relation.j))
        if lag.off(OFF):
            rpm = self.model.states[w] == "rad/s" and abs(lag.scale * RPM - 1) < OFF
            said = found_("sensor.scale", w, share=lag.scale, of=q, rpm=rpm)
            yield Finding(w, said, "scale", scale=lag.scale)
        elif relation.exact and lag.one_size:
            self.rule_out("rate_gain", q, w, [f"sensor_scale:{k}" for k in (q, w)])

    def rule_out(self, family: str, q: str, w: str, sensors: Sequence[str]) -> None:
        """Note effects that a position and its velocity rule out: of sensors, and on the rate of q.

        A heading rate that is only carried along shows what turns the robot, effects included.
        """
        carried = partner(self.model, q) == w
        self.refuted |= {*sensors} if carried else {*sensors, f"{family}:{q}"}

    def late(self, relation: Integral, lag: Lag) -> Iterator[Finding]:
        """Correct a delay beyond the model's own; the later sensor has it, since none is early."""
        d, least = float(abs(lag.delay)), LEAST_STEPS * self.dt
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
        """Undo the delay of state i behind another, or (rate) behind its derivative.

        A filtered state is only reported: a shift can't restore it.
        """
        d, name = float(abs(lag.delay)), self.names[i]
        follows: dict[str, Any] = {"of": of, "derivative": rate}
        times: dict[str, Any] = {"delay_s": d, "std_s": lag.std, "corrected": True}
        if lag.filtered:
            return Finding(name, found_("sensor.late", name, tau=d, **follows), "lag", **times)
        self.put(i, [earlier(x, d / self.dt) for x in self.column(i)])
        said = found_("sensor.late", name, by=_size(d, lag), **follows)
        return Finding(name, said, "delay", keys={"delay_s": float(f"{d:.3g}")}, **times)

    def filtered(self, relation: Integral, found: tuple[float, float, float]) -> Finding:
        """Drop a velocity that is computed from its position, to which it adds nothing.

        Around a stop it is wrong for as long as it averages.
        """
        (gain, std, age), (q, w) = found, (self.names[k] for k in (relation.i, relation.j))
        if abs(gain - 1) + SURELY * std < SLIGHT:
            self.rule_out("rate_gain", q, w, [f"sensor_scale:{k}" for k in (q, w)])
        self.put(relation.j, [np.full_like(x, np.nan) for x in self.column(relation.j)])
        self.shown.remove(relation.j)
        said = found_("sensor.derived", w, of=q, age=age)
        return Finding(w, said, "smoothed", corrected=True, source=q)

    def constant(self, relation: Integral) -> Iterator[Finding]:
        """Report a constant bias: of the velocity's sensor, or a drift of the position.

        If there is none, and one would have been seen, both causes are ruled out, since only
        together could they cancel.
        """
        bias, std, rms = bias_of(self.model, relation, self.trials)
        q, w = (self.names[k] for k in (relation.i, relation.j))
        if abs(bias) < SURELY * std and REPORTED_FROM * std < 2 * SLIGHT * rms:
            self.rule_out("offset", q, w, [f"sensor_bias:{w}"])
        elif abs(bias) > max(REPORTED_FROM * std, SLIGHT * rms):
            size, way = Quantity(abs(bias), self.model.states[w]), "more" if bias > 0 else "less"
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


def derived(
    model: Model, relation: Integral, trials: Sequence[Trial], least: float
) -> tuple[float, float, float] | None:
    """Return how a velocity follows from its position through a causal filter.

    That is the sum of the weights of the position's differences, its standard deviation, and their
    mean age [s]. None if it has another scale, is not explained by the position's past, or surely
    averages over less than `least` [s].
    """
    dt, logs, length = trials[0].dt, list(_rates(model, relation, trials)), PAST + LATER
    ways = [np.concatenate([[0.0], np.cumsum(moved)])[:, None] for _, moved, _ in logs]
    # an encoder is at rest on one count mostly
    floor = quantum([piece[:, 0] for piece, *_ in logs]) / np.sqrt(12)
    noise = float(np.max([floor, np.median([white_noise(way) for way in ways])]))
    long = [(moved / dt, w) for _, moved, w in logs if len(moved) >= length]
    rows = [np.lib.stride_tricks.sliding_window_view(rate, length)[:, ::-1] for rate, _ in long]
    count = sum(map(len, rows))
    if count < 2 * length:
        return None
    a = np.concatenate(rows)
    w = np.concatenate([w[PAST : PAST + len(r)] for (_, w), r in zip(long, rows, strict=True)])
    weights, _, rank, _ = np.linalg.lstsq(a, w, rcond=None)
    rest = w - a @ weights
    left = float(np.sqrt(rest @ rest / count))
    # the velocity must carry the position's noise as its weights would
    passed = noise * float(np.linalg.norm(np.diff(np.pad(weights, 1)))) / dt
    explained = left < GROSS * passed
    gain = float(weights.sum())
    if rank < length or not explained or abs(gain - 1) > OFF:
        return None
    covariance = np.linalg.inv(a.T @ a) * left**2
    ages = (np.arange(length) - LATER + 0.5) * dt
    age = float(weights @ ages) / gain
    apart = (ages - age) ** 2 + dt**2 / 12  # each difference is itself a mean over a step
    wide, std = 12 * float(weights @ apart), 12 * float(np.sqrt(apart @ covariance @ apart))
    if wide - SURELY * std < least**2:  # of the plain mean with this variance of ages
        return None
    return gain, float(np.sqrt(covariance.sum())), age


def bias_of(
    model: Model, relation: Integral, trials: Sequence[Trial]
) -> tuple[float, float, float]:
    """Return the bias of a logged velocity against its position, its std, and the velocity's rms.

    It is fitted over stretches, beside a scale: the velocity's mean less the position's rate. NaN
    with too little data.
    """
    dt, whole = trials[0].dt, list(_rates(model, relation, trials))
    steps, rows = sum(len(moved) for _, moved, _ in whole), list[tuple[float, float, int]]()
    for _, moved, w in whole:
        off = 0.5 * (w[1:] + w[:-1]) - moved / dt
        parts = max(1, min(-(-FEWEST_SAMPLES * len(off) // steps), len(off) // SHORTEST))
        for some in np.array_split(np.arange(len(off)), parts):
            rows.append((float(moved[some].mean()) / dt, float(off[some].mean()), len(some)))
    if len(rows) < FEWEST_SAMPLES // 2 or not np.ptp([rate for rate, *_ in rows]):
        return np.nan, np.nan, np.nan
    rates, offs, counts = np.array(rows).T
    (_, bias), spread = np.polyfit(rates, offs, 1, w=np.sqrt(counts), cov=True)
    rms = float(np.sqrt(np.mean(np.concatenate([w for *_, w in whole]) ** 2)))
    c = relation.c
    return float(bias) / c, float(np.sqrt(spread[1, 1])) / abs(c), rms / abs(c)


# --- a plane --------------------------------------------------------------------------------------


def late_positions(model: Model, trials: Sequence[Trial], both: Sequence[Row]) -> Lag | None:
    """Return the delay that both positions of a plane share behind velocities and heading, or None.

    The velocity S of a position that is late by d is off by -d S'. A slipping wheel acts along the
    path as well, a side slip or a tracked point ahead across it, a drift by a constant: beside
    these, none may remain of the delay. If the sideways velocity is not measured, it must show both
    along and across the path.
    """
    dt, columns, units = trials[0].dt, [row.i for row in both], list(model.states.values())
    ways = [(z[:, columns], s[:, columns]) for t in trials for z, s in per_step(model, t, both)]
    lag = lag_between([(said[:, k], moved[:, k]) for k in (0, 1) for moved, said in ways], dt)
    if lag is None or lag.sign < 0 or lag.coherence < NEARLY_ALL:
        return None
    apart = len({j for row in both for j in row.by if units[j].endswith("/s")}) < 2
    least = max(REPORTED_FROM * lag.std, 0.5 * dt)
    left = _left(ways, lag.delay / dt, dt, apart=apart) if lag.delay >= least else [(0.0, np.inf)]
    sure = all(max(std, abs(late) - SURELY * std) < PART * lag.delay for late, std in left)
    return lag if sure else None


def _left(
    ways: Sequence[tuple[Array, Array]], steps: float, dt: float, *, apart: bool
) -> list[tuple[float, float]]:
    """Return the delay [s] that remains after shifting positions, with its standard deviation.

    Along the path and across it if these are `apart`. Ways are the displacements of each piece,
    measured and by the other sensors (T, 2); the plane is one of complex numbers here.
    """
    h, rows = max(3, round(SMOOTH_S / dt)), list[Array]()
    window = np.hanning(2 * h + 3)[1:-1]
    window /= window.sum() * dt
    for moved, said in ways:
        early = at_samples(moved @ [1, 1j], np.arange(len(moved)) + steps)
        known = np.isfinite(early)
        if known.sum() < 3 * len(window):
            continue
        z, s = (np.convolve(one[known], window, "valid") for one in (early, said @ [1, 1j]))
        # a late position, beside slip along and across the path and a point ahead or aside
        size = np.maximum(np.abs(s), 1e-9)
        ahead = s / size
        slope = np.gradient(s, dt) * ahead.conj()
        turn, side = slope.imag / size, 1j * ahead
        late = [slope.real * ahead, slope.imag * side] if apart else [slope * ahead]
        columns = [z - s, *(-one for one in late), turn * side, -turn * ahead, ahead, side]
        centred = np.stack(columns, axis=1)
        centred -= centred.mean(axis=0)
        rows += [centred.real, centred.imag]
    every = np.concatenate(rows) if rows else np.zeros((0, 2))
    rest, design = every[:, 0], every[:, 1:]
    if len(rest) < 16 or np.linalg.matrix_rank(design) < design.shape[1]:
        return [(0.0, np.inf)]
    spread = np.linalg.inv(design.T @ design)
    found = spread @ design.T @ rest
    forces = design * (rest - design @ found)[:, None]
    parts = np.stack([part.sum(axis=0) for part in np.array_split(forces, 32)])
    stds = np.sqrt(np.diag(spread @ parts.T @ parts @ spread))
    return [(float(found[k]), float(stds[k])) for k in range(1 + apart)]
