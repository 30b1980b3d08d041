"""A score test of every candidate effect: its best values and gain in likelihood beside one fit.

Each candidate's columns (what it adds to a step, or to a measurement) are whitened with the Kalman
gains of the fit and regressed on its innovations:

    linear quantity     one column per unit of the quantity; its value from one solve
    scanned quantity    one column per grid value, the whole change with coefficient one. Linear
                        quantities beside it (a patch's strength, a wave's two amplitudes) are
                        solved at each grid point

The columns of what the fit already estimates (values of its effects, shifts of the parameters) are
projected out, so that a candidate is credited only with what they can't explain.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from grounded.compile import Named
from grounded.diagnosis.likelihood.delays import delays_of, sensor_offset
from grounded.diagnosis.likelihood.fitted import Fitted
from grounded.diagnosis.likelihood.hypothesis import of_sensor
from grounded.diagnosis.likelihood.linearise import base_columns, filter_system, sensitivities_of
from grounded.diagnosis.likelihood.moving import moving
from grounded.diagnosis.likelihood.predictor import Predictor
from grounded.diagnosis.likelihood.tangent import tangent
from grounded.effects import (
    Effect,
    InputFamily,
    LossFamily,
    MediumFamily,
    MemoryFamily,
    ParamFamily,
    RateFamily,
)
from grounded.effects.sensed import behind_logs
from grounded.engine import Shared, each
from grounded.filter import kalman
from grounded.frozen import Array

BLOCK = 160  # most columns filtered at once
MOST_NUMBERS = 2.5e5  # size of one block of whitened columns; what fits in the cache is fastest
CACHED = 6e4  # numbers of the columns of some runs that are whitened at once
_EMPTY: Array = np.zeros((0, 0))


@dataclass(frozen=True, eq=False)
class Look:
    """The result of a scan for one candidate: its best values and their gain [nats]."""

    effect: Effect
    values: dict[str, float]
    gain: float
    others: tuple[dict[str, float], ...] = ()  # other grid points that gain nearly as much


@dataclass(frozen=True, eq=False)
class _Column:
    effect: int  # index of the candidate
    point: int  # index of its grid point
    name: str  # linear quantity, or "" for the whole change at a grid point
    d: Array  # (L, B, n) or empty
    r: Array  # (L + 1, B, n) or empty


@dataclass(frozen=True, eq=False)
class _Tried:
    """What a column changes: a linear value by a small amount, or all of a grid point."""

    point: int
    name: str
    amount: float
    values: dict[str, float]


_Points = Sequence[tuple[int, dict[str, float]]]  # index of a grid point, its values
_Point = tuple[int, int, Effect, dict[str, float]]  # candidate, grid point, effect, its values
# by candidate and grid point: of each column its name and its products with residual, base, mates
_Results = dict[tuple[int, int], list[tuple[str, float, Array, Array]]]


def scan_candidates(predictor: Predictor, fit: Fitted, candidates: Sequence[Effect]) -> list[Look]:
    """Scan every candidate beside what `fit` already holds; return looks in the same order."""
    context = _Context(predictor, fit)
    results: _Results = {}
    blocks: list[list[_Point]] = [[]]
    held = 0
    for i, effect in enumerate(candidates):
        together = max(1, sum(not q.grid for q in effect.free))
        for point, grid in enumerate(grid_points(effect)):
            if held + together > context.together and blocks[-1]:
                blocks.append([])
                held = 0
            blocks[-1].append((i, point, effect, grid))
            held += together

    for found in each(_looked, [context] * len(blocks), blocks):
        results |= found
    return [context.best(i, effect, results) for i, effect in enumerate(candidates)]


def _looked(context: _Context, block: Sequence[_Point]) -> _Results:
    """Return the products of a block of columns, which holds all columns of each grid point."""
    results: _Results = {}
    columns = list[_Column]()
    for i, some in itertools.groupby(block, key=lambda one: one[0]):
        points = list(some)
        columns += context.columns(i, points[0][2], [(point, grid) for _, point, _, grid in points])
    if columns:
        context.filter(columns, results)
    return results


class _Context(Shared):
    """The fit's track, Jacobian and gains, shared by all candidates."""

    def __init__(self, predictor: Predictor, fit: Fitted) -> None:
        self.predictor, self.fit = predictor, fit
        data, h = predictor.data, fit.hypothesis
        self.x = fit.track[:-1]
        self.u = predictor.inputs(h)
        self.after = predictor.advance(h, self.x, self.u, data.time)
        self.ahead = np.concatenate([fit.track[:1], self.after])
        self.F, self.f_p = sensitivities_of(predictor, h, self.x, self.u, self.after)
        system, delayed = filter_system(predictor, h, fit.noise, fit.track, self.F)
        self.G, self.gains = system.G, kalman.gains(system, delayed)
        self.delays = delays_of(h, data)
        self.white = fit.white
        self.together = max(8, min(BLOCK, int(MOST_NUMBERS / fit.white.size)))
        self.base = fit.covariance if fit.gram.shape[-1] else np.zeros((0, 0))

    def columns(self, i: int, effect: Effect, points: _Points) -> list[_Column]:
        """Return the columns of a candidate at some of its grid points."""
        family, tried = effect.family, self._tried(effect, points)
        if isinstance(family, RateFamily) and not family.parts:
            changes = self._rate(effect, tried)
        elif isinstance(
            family, InputFamily | LossFamily | MediumFamily | MemoryFamily | RateFamily
        ):
            changes = self._step(effect, tried)
        elif of_sensor(effect):
            return [
                _Column(i, one.point, one.name, _EMPTY, self._sensor(effect, one)) for one in tried
            ]
        elif isinstance(family, ParamFamily):
            k = self.predictor.data.model.param_names.index(effect.site.target)
            return [_Column(i, point, "d", self.f_p[..., k], _EMPTY) for point, _ in points]
        else:
            return []
        return [
            _Column(i, one.point, one.name, d, _EMPTY)
            for one, d in zip(tried, changes, strict=True)
        ]

    @staticmethod
    def _tried(effect: Effect, points: _Points) -> list[_Tried]:
        """Return what each column changes: a linear value by a small amount, or a grid value."""
        linear, found = [q.name for q in effect.free if not q.grid], list[_Tried]()
        for point, grid in points:
            values = {**effect.fixed, **dict.fromkeys(linear, 0.0), **grid}
            for name in linear:
                found.append(_Tried(point, name, 1e-3, values | {name: 1e-3}))
            if not linear:
                found.append(_Tried(point, "", 1.0, values))
        return found

    def _rate(self, effect: Effect, tried: Sequence[_Tried]) -> Array:
        """Return what K columns of an added rate add to a step, to first order (K, L, B, n)."""
        predictor, seen = self.predictor, self.predictor.seen
        amount = np.array([one.amount for one in tried]).reshape(-1, 1, 1)
        values = {q: _alike([one.values[q] for one in tried]) for q in tried[0].values}
        before, later = (self._rates_at(effect, values, when) for when in (0, 1))
        part, d = 0.5 * predictor.data.dt / amount, np.zeros((len(tried), *self.x.shape))
        for state, rate in before:
            d += self._by_state[seen.index(state)] * np.multiply(part, rate)[..., None]
        for state, rate in later:
            d[..., seen.index(state)] += part * rate
        if behind_logs(predictor.data.model) is not None:
            d = predictor.logged(self.fit.hypothesis, np.zeros_like(d), d)
        for a, b in predictor.tied:
            if effect.family.needs_own:  # type: ignore[attr-defined]
                before, later = (self._rates_at(effect, values, k, instant=True) for k in (0, 1))
            d[..., b] = (self._entering[b] * d).sum(axis=-1)
            for sign, rates in ((-1, before), (1, later)):
                for rate in (rate for state, rate in rates if state == seen[a]):
                    d[..., b] += sign * rate / amount
        return d

    @cached_property
    def _by_state(self) -> Array:
        """F with its columns first, (n, L, B, n), since one effect changes only a few states."""
        return np.ascontiguousarray(np.moveaxis(self.F, -1, 0))

    @cached_property
    def _entering(self) -> dict[int, Array]:
        """How changes of the other states enter each carried heading rate, (L, B, n)."""
        found = {}
        for _, b in self.predictor.tied:
            assert self.G is not None
            found[b] = self.G[..., b, :].copy()
            found[b][..., b] = 0.0
        return found

    def _rates_at(
        self, effect: Effect, values: Mapping[str, Any], when: int, instant: bool = False
    ) -> list[tuple[str, Any]]:
        """Return added rates with their states at the start (0) or the end (1) of every step."""
        data = self.predictor.data
        x = self.x if when == 0 else self.after
        if medium := moving(self.fit.hypothesis, self.predictor.seen):
            x = medium.through(x)
        t = data.time if when == 0 else data.time + data.dt
        own: Any = {}
        if effect.family.needs_own:  # type: ignore[attr-defined]
            own = self.instants[when] if instant else self.mean
        return list(self.predictor.each_added([(effect, values)], x, self.u, t, own))

    @cached_property
    def mean(self) -> Named:
        """The model's own mean rates over every step."""
        ahead = self.predictor.moved(self.fit.hypothesis, self.x, self.u)
        return self.predictor.named((ahead - self.x) / self.predictor.data.dt)

    @cached_property
    def instants(self) -> tuple[Named, Named]:
        """The model's own rates at the start and at the end of every step."""
        h = self.fit.hypothesis
        start, end = (self.predictor.instant(h, x, self.u) for x in (self.x, self.after))
        return self.predictor.named(start), self.predictor.named(end)

    @cached_property
    def stepping(self) -> tuple[Predictor, Array]:
        """The predictor for steps with a candidate (linear for a simulator), and steps without."""
        near = tangent(self.predictor, h := self.fit.hypothesis, self.x, self.u)
        if near is self.predictor:
            return near, self.after
        return near, near.advance(h, self.x, self.u, self.predictor.data.time)

    def _step(self, effect: Effect, tried: Sequence[_Tried]) -> Array:
        """Return what K columns add to a step, by repeating it with the candidate (K, L, B, n)."""
        data, (predictor, base) = self.predictor.data, self.stepping
        with_it = [self.fit.hypothesis.plus(effect, one.values) for one in tried]
        after = predictor.each_next(with_it, self.fit.track)
        d = data.model.difference(after, base)
        d /= np.array([one.amount for one in tried]).reshape(-1, 1, 1, 1)
        d[..., data.exact] = 0.0
        return np.asarray(d)

    def _sensor(self, effect: Effect, one: _Tried) -> Array:
        """Return what a column adds to the measurements (L + 1, B, n)."""
        data, r = self.predictor.data, np.zeros_like(self.fit.track)
        for k in (data.model.state_names.index(name) for name in effect.site.targets):
            r[..., k] = -sensor_offset(effect, one.values, self.ahead[..., k], data.dt) / one.amount
        return r if self.delays is None else self.delays.aligned(r)

    def filter(self, block: list[_Column], results: _Results) -> None:
        """Whiten a block of columns; store their products with residual, base and each other."""
        L, B, n = self.white.shape
        wide = kalman.whole(len(block), n)
        products, own = np.zeros((wide, 1 + self.base_white.shape[-1])), np.zeros((wide, wide))
        delays = any(column.r.size for column in block)
        for runs, gains, beside in self._parts:
            count = len(range(B)[runs])
            d = _side_by_side([c.d[:, runs] for c in block], (L, count, n, wide))
            r = np.zeros((L + 1, count, n, wide))
            if delays:
                r = _side_by_side([c.r[:, runs] for c in block], (L + 1, count, n, wide))
            flat = kalman.innovations(gains, d, r)[0].reshape(-1, wide)
            products += flat.T @ beside
            own += flat.T @ flat
        against, cross = products[:, 0], products[:, 1:]
        places = [(column.effect, column.point) for column in block]
        for j, (column, place) in enumerate(zip(block, places, strict=True)):
            mates = [k for k, other in enumerate(places) if other == place]
            entry = (column.name, float(against[j]), cross[j], own[j, mates])
            results.setdefault(place, []).append(entry)

    @cached_property
    def _parts(self) -> list[tuple[slice, kalman.Gains, Array]]:
        """A few runs at a time: which, their gains, and their residual and base by row."""
        L, B, n = self.white.shape
        some = max(1, int(CACHED / (L * n * kalman.whole(self.together, n))))
        base = self.base_white.reshape(L, B, n, -1)
        columns = np.concatenate([self.white[..., None], base], axis=-1)
        return [
            (cut, self.gains.of_runs(cut), columns[:, cut].reshape(-1, columns.shape[-1]))
            for cut in (slice(at, at + some) for at in range(0, B, some))
        ]

    @cached_property
    def base_white(self) -> Array:
        """Whitened columns of the fit's own unknowns, (L B n, C)."""
        d, r = base_columns(self.predictor, self.fit)
        white = np.zeros((*d.shape[:-1], 0))
        if d.shape[-1]:
            white, _ = kalman.innovations(self.gains, d, r)
        return white.reshape(self.white.size, d.shape[-1])

    @cached_property
    def base_score(self) -> Array:
        """Slope of the negative log posterior in the fit's own unknowns, (C,); 0 at its optimum."""
        score = self.base_white.T @ self.white.reshape(-1)
        return np.asarray(score + self.fit.prior_pull(self.predictor.data))

    def best(self, i: int, effect: Effect, results: _Results) -> Look:
        """Return the grid point with the largest gain, with its linear values solved."""
        looks, changes = [], []
        for point, grid in enumerate(grid_points(effect)):
            entries = results.get((i, point), [])
            if not entries:
                continue
            names = [entry[0] for entry in entries]
            score = np.array([entry[1] for entry in entries])
            cross = np.array([entry[2] for entry in entries]).reshape(len(entries), -1)
            gram = np.array([entry[3] for entry in entries])
            score = score - cross @ self.base @ self.base_score
            gram = gram - cross @ self.base @ cross.T
            size = np.sqrt(np.maximum(np.diag(gram), 1e-300))
            if names == [""]:
                changes.append((grid, float(score[0]), float(gram[0, 0])))
                continue
            if not np.isfinite(size).all() or (size < 1e-8).any():
                looks.append((0.0, {**grid, **dict.fromkeys(names, 0.0)}))
                continue
            scaled = gram / np.outer(size, size)
            value = -np.linalg.lstsq(scaled, score / size, rcond=1e-9)[0] / size
            value = inside(effect, names, value)
            gain = -float(value @ score) - 0.5 * float(value @ gram @ value)
            looks.append((gain, {**grid, **dict(zip(names, value.tolist(), strict=True))}))
        looks += between(effect, changes)
        if not looks:
            return Look(effect, {}, 0.0)
        looks.sort(key=lambda look: -look[0])
        return Look(effect, looks[0][1], looks[0][0], elsewhere(effect, looks))


def _alike(each: Sequence[float]) -> Any:
    """Return the value that all share, or all of them (K, 1, 1)."""
    return each[0] if len({*each}) == 1 else np.array(each).reshape(-1, 1, 1)


def _side_by_side(columns: Sequence[Array], shape: tuple[int, ...]) -> Array:
    """Stack columns of one shape (empty ones: zero) along the last axis."""
    rows = np.zeros((shape[-1], *shape[:-1]))
    for row, column in zip(rows, columns, strict=False):
        if column.size:
            row[:] = column
    return np.ascontiguousarray(rows.reshape(len(rows), -1).T).reshape(shape)


MOST_OTHERS = 2  # places beside the best from which a fit starts
FAINT = 0.05  # least way from a weaker grid point, so that a fit has a slope to start from


def grid_points(effect: Effect) -> list[dict[str, float]]:
    """Return all combinations of scanned values; one empty point if all quantities are linear."""
    grids = {q.name: q.grid for q in effect.free if q.grid}
    return [dict(zip(grids, point, strict=True)) for point in itertools.product(*grids.values())]


def inside(effect: Effect, names: Sequence[str], value: Array) -> Array:
    """Return values of linear quantities, clipped to their bounds."""
    bounds = {q.name: (q.low, q.high) for q in effect.free}
    return np.array([np.clip(v, *bounds[name]) for name, v in zip(names, value, strict=True)])


def elsewhere(
    effect: Effect, looks: list[tuple[float, dict[str, float]]]
) -> tuple[dict[str, float], ...]:
    """Return the best of the other local maxima of the gain over the grid, given best first.

    A change is linear only near the fit that is scanned, so the best grid point need not lead to
    the best fit. A local maximum has no grid point beside it that gains more.
    """
    grids = {q.name: np.sort(np.array(q.grid)) for q in effect.free if q.grid}
    at = np.array(
        [[np.argmin(np.abs(grid - v[n])) for n, grid in grids.items()] for _, v in looks], int
    )
    found = [
        values
        for k, (gain, values) in enumerate(looks)
        if gain > 0 and (np.abs(at[:k] - at[k]).max(axis=1, initial=0) > 1).all()
    ]
    return tuple(found[1 : 1 + MOST_OTHERS])


def between(
    effect: Effect, changes: Sequence[tuple[dict[str, float], float, float]]
) -> list[tuple[float, dict[str, float]]]:
    """Return the best gain and value between each grid point and the next weaker one.

    A change is taken as linear between two grid points, and between the weakest and none. So a
    threshold is found that a few samples exceed, where one grid point does nothing and the next too
    much. Of several scanned quantities together, a part of the change is taken for the gain of all.

    Args:
        effect: an effect without linear quantities.
        changes: each grid point, its score (the gain's slope, negated) and its squared size.
    """
    found = []
    for grid, score, gram in changes:
        if len(grid) > 1:
            found.append((0.5 * max(-score, 0.0) ** 2 / max(gram, -score, 1e-300), grid))
            continue
        ((name, value),) = grid.items()
        (none,) = (q.start for q in effect.free if q.name == name)
        away = {other[name]: size for other, _, size in changes}
        weaker = [c for c in away if 0 <= (c - none) / (value - none) < 1]
        below = min(weaker, key=lambda c: abs(c - value), default=none)
        size = away.get(below, 0.0)
        least = float(np.sqrt(size / gram)) if 0 < size < gram else 0.0
        part = float(np.clip(-score / gram, least, 1.0)) if gram > 0 else 1.0
        way = max((part - least) / (1 - least), FAINT)
        gain = -part * score - 0.5 * part**2 * gram
        found.append((gain, {name: below + way * (value - below)}))
    return found
