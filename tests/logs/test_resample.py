"""Samples onto the grid: against signals whose true values are known, and defects of real logs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from facts import holding, of_code
from grounded.errors import GroundedError
from grounded_trials.logs.resample import END, START, Crossing, Span, to_grid
from grounded_trials.logs.signals import Series, SignalSpec

EPOCH = 1_700_000_000_000_000_000


def series(t: np.ndarray, y: np.ndarray, spec: SignalSpec | None = None) -> Series:
    stamps = EPOCH + np.round(np.asarray(t) * 1e9).astype(np.int64)
    return Series(
        spec=spec or SignalSpec("/a.b"),
        t=stamps,
        values=np.asarray(y, float),
        log_times=stamps,
        messages=len(stamps),
        type="a/B",
    )


def command(t0: float = 0.0, t1: float = 2.0, dt: float = 0.05) -> Series:
    t = np.arange(t0, t1, dt)
    return series(t, np.arange(len(t)), SignalSpec("/u.data", "log"))


def pose(f: Callable[[np.ndarray], np.ndarray], rate: float = 97.0, **spec: object) -> Series:
    t = np.arange(-0.5, 3.0, 1 / rate)
    return series(t, f(t), SignalSpec("/x.data", **spec))  # type: ignore[arg-type]


def grid(x: Series, u: Series | None = None, **options: object):  # type: ignore[no-untyped-def]
    return to_grid({"x": x, "u": u or command()}, 0.05, ["x"], ["u"], **options)  # type: ignore[arg-type]


def test_a_delay_is_taken_back() -> None:
    speed = 1.0  # [m/s]: 7 ms are 7 mm
    stamps_late = pose(lambda t: speed * (t - 0.007))
    assert np.abs(grid(stamps_late).states[:, 0] - 0.05 * np.arange(41)).max() > 0.0069
    mended = pose(lambda t: speed * (t - 0.007), delay_s=0.007)
    np.testing.assert_allclose(grid(mended).states[:, 0], 0.05 * np.arange(41), atol=1e-9)


def noisy(f: Callable[[np.ndarray], np.ndarray], seed: int, **spec: object) -> Series:
    rng = np.random.default_rng(seed)
    return pose(lambda t: f(t) + 0.02 * rng.standard_normal(len(t)), rate=20.3, **spec)


def test_where_a_run_began_is_told_by_the_samples_before_it() -> None:
    def left(t: np.ndarray) -> np.ndarray:
        return 0.3 + 0.8 * np.maximum(t, 0.0) ** 2

    rows, told = [], []
    for seed in range(40):
        v = noisy(lambda t: 1.6 * np.maximum(t - 0.5, 0), 100 + seed)
        log = {"x": noisy(lambda t: left(t - 0.5), seed), "v": v, "u": command(0.5)}
        found = to_grid(log, 0.05, ["x", "v"], ["u"], rates=["v"])
        rows.append(found.states[0, 0] - 0.3)
        told.append(found.start_states.get("x", np.nan) - 0.3)
    assert np.isfinite(told).mean() > 0.95  # now and then noise itself looks like a motion
    assert np.nanstd(told) < 0.5 * np.std(rows) and abs(np.nanmean(told)) < 0.003


def test_a_precise_curve_is_not_told_by_a_straight_line() -> None:
    found = grid(pose(lambda t: 2 * t + 0.5 * t**2, rate=1000.0))
    assert abs(found.start_states.get("x", found.states[0, 0])) < 1e-4


def test_scale_offset_and_unwrapping() -> None:
    def wrapped_degrees(t: np.ndarray) -> np.ndarray:
        return np.rad2deg((2 * t + np.pi) % (2 * np.pi) - np.pi)

    scaled = pose(wrapped_degrees, scale=np.pi / 180, offset=1.0, unwrap=True)
    found = grid(scaled).states[:, 0]
    np.testing.assert_allclose(found - found[0], 0.1 * np.arange(41), atol=1e-9)
    assert abs(found[0] - 1.0) < 1e-9
    as_angle = grid(replace(scaled, spec=replace(scaled.spec, unwrap=False)), angles=["x"])
    np.testing.assert_array_equal(as_angle.states[:, 0], found)


@pytest.mark.parametrize(("turn", "wrapped"), [(2 * np.pi, True), (360.0, True), (360.0, False)])
def test_an_angle_is_unwrapped_by_its_own_turn(turn: float, wrapped: bool) -> None:
    """In degrees at 97 Hz it turns by 5.6 in a sample, which must not be folded by 2 pi."""

    def angle(t: np.ndarray) -> np.ndarray:
        y = 1.5 * turn * t
        return (y + turn / 2) % turn - turn / 2 if wrapped else y

    found = grid(pose(angle), angles=["x"]).states[:, 0]
    assert np.ptp(np.diff(found)) < 1e-4 and abs(found[20] - found[0] - 1.5 * turn) < 1e-4


def test_a_gap_is_refused_where_it_is_and_bridged_where_allowed() -> None:
    x = pose(np.sin)
    keep = (x.t < EPOCH + 1.0e9) | (x.t > EPOCH + 1.9e9)
    gap = replace(x, t=x.t[keep], values=x.values[keep], log_times=x.log_times[keep])
    with pytest.raises(GroundedError, match=r"\b0.99\d s .*\b1.9\d\d s") as e:
        grid(gap)
    assert "'x' (/x.data)" in str(e.value)
    found = grid(replace(gap, spec=replace(gap.spec, max_age_s=1.0)))
    (report, _) = found.reports
    assert report.bridged == 19 and 0.9 < report.largest_gap_s < 0.93
    assert 0.98 < report.largest_gap_at_s < 1.0 and found.findings[0].facts["bridged"] == 19
    assert grid(gap, span=Span(end=1.4)).states.shape == (19, 1)  # before the gap all is well


def test_held_inputs_grow_old() -> None:
    u = series(np.array([0.0, 0.1, 1.0]), np.arange(3), SignalSpec("/u", "log"))
    assert grid(pose(np.sin), u).inputs.shape[0] > 50  # a command is in force until the next
    strict = replace(u, spec=replace(u.spec, max_age_s=0.5))
    with pytest.raises(GroundedError, match=r"\b0.100 s"):
        grid(pose(np.sin), strict)


def test_one_shot_topics() -> None:
    u = series(np.array([0.0]), np.array([0.3]), SignalSpec("/u", "log"))
    found = grid(pose(np.sin), u)
    assert (found.inputs == 0.3).all() and found.findings[0].about == ("u",)
    with pytest.raises(GroundedError, match=holding('resample = "hold"')):
        grid(series(np.array([0.0]), np.array([1.0])))


def test_values_that_are_no_numbers() -> None:
    x = pose(np.sin)
    values = x.values.copy()
    values[::7] = np.nan
    values[3] = np.inf
    found = grid(replace(x, values=values))
    t = 0.05 * np.arange(len(found.states))
    np.testing.assert_allclose(found.states[:, 0], np.sin(t), atol=2e-4)
    assert found.reports[0].not_finite == np.sum(~np.isfinite(values))
    with pytest.raises(GroundedError, match=holding(340, "finite")):
        grid(replace(x, values=np.full(len(values), np.nan)))


def test_clocks_that_jump_or_differ_are_refused() -> None:
    x = pose(np.sin)
    reset = x.t.copy()
    reset[200:] -= 5_000_000_000
    with pytest.raises(GroundedError, match=holding("clock", "4.990 s", "sample 199")):
        grid(replace(x, t=reset, log_times=reset))
    simulated = replace(x, t=x.t - EPOCH + 929 * 10**9)
    with pytest.raises(GroundedError, match=holding("clock", "log")):
        grid(simulated)
    zero = replace(x, t=np.zeros_like(x.t))
    with pytest.raises(GroundedError, match=r"\bclocks\b|stamps are 0"):
        grid(zero)
    some = x.t.copy()
    some[:3] = 0
    assert grid(replace(x, t=some)).reports[0].stamps == 3


def test_the_span() -> None:
    x, u = pose(np.sin), command()
    assert grid(x, u, span=Span(start=1.0)).start_ns == EPOCH + 500_000_000  # 1 s after x began
    assert grid(x, u, span=Span(EPOCH * 1e-9 + 0.25)).start_inputs.tolist() == [4]
    assert grid(x, u, steps=10).states.shape == (11, 1)
    armed = series(np.array([-0.4, 0.7, 1.0, 1.2]), np.array([0, 1, 1, 0]))
    span = Span(Crossing("/armed", above=0), Crossing("/armed", below=0.5))
    found = to_grid({"x": x, "u": u, START: armed, END: armed}, 0.05, ["x"], ["u"], span)
    assert found.start_ns == EPOCH + 700_000_000 and len(found.inputs) == 10
    assert found.start_inputs is not None and found.start_inputs.tolist() == [13]
    never = Span(Crossing("/armed", above=2))
    with pytest.raises(GroundedError, match=holding("/armed", "above 2", 0)):
        to_grid({"x": x, "u": u, START: armed}, 0.05, ["x"], ["u"], never)
    with pytest.raises(GroundedError, match="0 steps"):
        grid(x, u, span=Span(1.0, 0.5))
    late = grid(pose(np.sin), command(-1.0))
    assert late.late_s == pytest.approx(0.5, abs=0.001) and of_code(late, "file.vanished")


def driven(rows: np.ndarray, every: float, **spec: object) -> Series:
    """A command that a driver changes at any row, at least so many seconds apart, at 100 Hz."""
    rng, t = np.random.default_rng(2), np.arange(0.0, 20.0, 0.025)
    at = np.cumsum(rng.choice(rows, 60)) * every
    return series(t, np.searchsorted(at, t + 1e-9, "right") % 5, SignalSpec("/x.u", "log", **spec))


def test_a_driver_s_commands_are_neither_early_nor_late() -> None:
    x = pose(np.sin)
    x = series(np.arange(-0.5, 21.0, 0.025), np.zeros(860), x.spec)
    u = driven(np.array([7, 8, 9]), 0.025)
    found = grid(x, u, rest=np.zeros(1)).inputs[:, 0]
    rows = u.values.reshape(-1, 2)[: len(found)]
    assert (np.diff(rows, axis=1) != 0).sum() > 10  # many in the middle of a step
    assert found[: len(rows)] == pytest.approx(rows.mean(axis=1))
    # of commands in steps, and of a candidate's run, each step has one that was sent
    steps = driven(np.array([8, 10]), 0.025)
    for each, how in ((steps, {"rest": np.zeros(1)}), (u, {})):
        assert set(grid(x, each, **how).inputs[:, 0]) <= set(u.values)
    asked = driven(np.array([7, 8, 9]), 0.025, resample="hold")
    assert set(grid(x, asked, rest=np.zeros(1)).inputs[:, 0]) <= set(u.values)


@given(st.integers(0, 2**32 - 1))
def test_any_jitter_any_loss_any_order_stays_near_the_truth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.arange(-0.5, 3.0, 0.01) + rng.uniform(-0.004, 0.004, 350)
    keep = rng.random(350) > 0.3
    order = rng.permutation(np.flatnonzero(keep))
    x = series(t[order], np.sin(t[order]), SignalSpec("/x", max_age_s=0.2))
    jumps = -np.diff(x.t).min() > 1e9
    try:
        found = grid(x)
    except GroundedError as error:
        assert jumps and "jumps back" in str(error)
        return
    times = 0.05 * np.arange(len(found.states))
    np.testing.assert_allclose(found.states[:, 0], np.sin(times), atol=5e-3)


def test_stamps_in_milliseconds_are_refused_with_what_to_do() -> None:
    def slow(s: Series) -> Series:
        t = EPOCH + 1000 * (s.t - EPOCH)
        return replace(s, t=t, log_times=t)

    with pytest.raises(GroundedError, match=r"every 10.3 s.*t_ms"):
        grid(slow(pose(np.sin)), slow(command()))


def test_a_state_that_vanishes_half_way_is_told() -> None:
    whole, part = pose(np.sin), pose(np.cos)
    n = len(part.t) // 2
    cut = {name: getattr(part, name)[:n] for name in ("t", "values", "log_times")}
    half = replace(part, **cut)
    signals = {"x": whole, "v": half, "u": command()}
    found = to_grid(signals, 0.05, ["x", "v"], ["u"])
    assert any(one.code == "file.vanished" and "v" in one.about for one in found.findings)
    found = to_grid(signals | {"v": part}, 0.05, ["x", "v"], ["u"])
    assert not any(one.code == "file.vanished" and "v" in one.about for one in found.findings)
