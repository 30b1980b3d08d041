"""Sentences about the ruler's rows: what is said must be what the rows hold."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from facts import holds
from grounded import Trial
from grounded.diagnosis.cause_words import as_large, with_worth
from grounded.diagnosis.error_report import (
    AT_MOST,
    Credit,
    Part,
    Region,
    Remainder,
    RulerRow,
    furthest,
    runaway,
)
from grounded.diagnosis.next_trial import LOG, LOST, next_trial
from grounded.diagnosis.report import (
    Agreement,
    Diagnosis,
    Estimate,
    Likeness,
    Ranked,
    Unconfirmed,
)
from grounded.diagnosis.ruler_words import (
    explained,
    improvement,
    in_doubt,
    objection,
    open_noise,
    outweighed,
    rest,
    telling,
    worsened,
)
from grounded.diagnosis.tables import effect_table, error_table, larger
from grounded.diagnosis.unconfirmed import _anywhere, another_look, unrepeatable
from grounded.diagnosis.verdict import _late_or_filtered, _unneeded, verdict
from grounded.effects import Library
from grounded.models import car, pendulum
from small_tasks import cart_task

UNITS = {"x": "m", "v": "m/s"}


def row(crude, after, floor=None, **more):
    return RulerRow(
        more.pop("horizon_s", 1.0),
        unit_by_channel=UNITS,
        crude=crude,
        with_effects=after,
        noise_floor=floor or {},
        **more,
    )


def test_what_the_task_follows_is_named_before_what_improves_by_hardly_more():
    some = row({"x": 1.0, "v": 1.0}, {"x": 0.15, "v": 0.01})
    units = {**UNITS, "w": "1/s"}
    three = replace(
        some,
        unit_by_channel=units,
        crude={**some.crude, "w": 1.0},
        with_effects={**some.with_effects, "w": 0.02},
    )
    assert improvement((three,)).startswith("Predictions 1 s ahead miss v by 0.010 m/s")
    assert holds(improvement((three,), ("x",)), "miss x by", "and v by")
    poor = replace(three, with_effects={"x": 0.5, "v": 0.01, "w": 0.02})
    assert " x " not in improvement((poor,), ("x",))


def test_what_got_worse_is_said_of_the_channel_that_lost_most():
    short = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.6})
    whole = row({"x": 2.12, "v": 0.5}, {"x": 3.79, "v": 0.3}, whole_trial=True, horizon_s=60.0)
    said = worsened((short, whole))
    assert holds(said, "worse for x", "3.8 m", "2.1 m")
    assert "0.60 m/s" in worsened((short,))
    assert outweighed((short, whole)) and not outweighed((short,))
    assert "improve" not in said and "improve over all" in worsened((short,))
    wild = replace(whole, with_effects={"x": 6e5, "v": 0.3}, runs_away={"with_effects": ("x",)})
    said = worsened((short, wild))
    assert "diverge for x" in said and "2.1 m" in said and "0,000" not in said  # no distance


def test_every_state_that_gets_worse_is_told_at_the_horizon_where_it_loses_most():
    near = row({"x": 1.8e-3, "y": 1.3e-3}, {"x": 1.7e-3, "y": 1.5e-3}, horizon_s=0.5)
    far = row({"x": 2.97e-3, "y": 2.55e-3}, {"x": 3.33e-3, "y": 2.75e-3})
    named = {"unit_by_channel": {"x": "m", "y": "m"}, "noise_floor": {"x": 1e-3, "y": 1e-3}}
    said = worsened(tuple(replace(one, **named) for one in (near, far)))
    assert holds(said, "0.5 s ahead get worse for y: 1.5 mm instead of 1.3 mm")
    assert (
        holds(said, "1.3 mm and 1 s ahead for x: 3.3 mm instead of 3.0 mm")
        and said.count("for y") == 1
    )


def test_where_noise_alone_leaves_all_that_was_measured_nothing_is_told_of_a_horizon():
    short = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.5}, horizon_s=0.5)
    far = row({"x": 2.0, "v": 5.0}, {"x": 1.9, "v": 9.0}, horizon_s=1.0, drowned=True)
    assert furthest((short, far)) is short and furthest((far,)) is far and furthest(()) is None
    assert "0.5 s ahead" in improvement((short, far)) and worsened((short, far)) == ""
    fell = row({"x": 2.0, "v": 1.6}, {"x": 0.1, "v": 2.2}, whole_trial=True, horizon_s=40.0)
    assert "get worse for v" in worsened((short, fell))
    assert worsened((short, far, fell)) == ""  # a balancer's 40 s without feedback
    assert "whole" not in improvement((short, far, fell)) and telling((short, far, fell)) is short


def test_what_few_repeats_may_have_missed_of_the_noise_is_not_left_over():
    sure = row({"x": 2.0}, {"x": 0.15}, {"x": 0.1})
    assert "1.5 times" in rest((sure,))
    assert not rest((replace(sure, floor_unsure=0.2),))


def test_what_predictions_get_worse_with_is_contested_and_no_sentence_says_adopt():
    short = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.6})
    whole = row({"x": 2.12, "v": 0.5}, {"x": 3.79, "v": 0.3}, whole_trial=True, horizon_s=60.0)
    alike, unlike = (Agreement("delay:u", "d", agrees=agrees) for agrees in (True, False))
    assert objection((short, whole), (alike,), ("delay:u",))
    assert not objection((short, whole), (alike,), ())
    assert not objection((short,), (alike,), ("delay:u",))
    assert objection((short,), (unlike,), ("delay:u",))
    claims = _claiming(Library().effect("coulomb_friction:v", cart_task().model))
    assert next_trial(claims, "", ()).endswith("adopt the claimed effects.")
    why = objection((short,), (unlike,), ("delay:u",))
    assert holds(why, "delay:u", "disagree") and "disagree" not in objection(
        (short, whole), (unlike,), ("delay:u",)
    )
    said = next_trial(claims, "", (), worse=why)
    assert why in said and not said.endswith("adopt the claimed effects.")
    assert "Run" not in said  # "No trial is needed: the search has ended" may precede it
    look = "Run c0001 twice more, to see whether the gap in v repeats."
    said = next_trial(claims, look, ())  # the verdict speaks of a gap
    assert holds(said, "adopt the claimed effects and diagnose again", "run c0001 twice more")
    look = "Run c0001 twice more, to see how much of what is left in v is noise."
    said = next_trial(claims, look, (), noise=True)  # the verdict names no gap: a crane's
    assert "gap" not in said and holds(said, "adopt the claimed effects.", "run c0001 twice more")
    pair = ("coulomb_friction:v", "viscous_friction:v")
    said = next_trial(claims, "", (pair,), same=(pair,))
    assert said.startswith("No trial helps")
    assert said.endswith("the claimed one, coulomb_friction:v.")
    assert why in next_trial(claims, "", (pair,), same=(pair,), worse=why)
    said = next_trial(claims, "", (pair,), same=(pair,), flip="force")
    assert holds(said, "flip the sign of force", "diagnose again") and "adopt" not in said
    assert "Widen the bounds" in next_trial(claims, "", (), ended=True)
    said = next_trial(claims, "", (), ended=True, flip="force")  # `diagnose` asked for wider ones
    assert holds(
        said, "force acts the other way round", "ratio", "model.py", "[log.input.force] by -1"
    )
    assert "bounds in the model file" not in said


def test_what_ties_and_gains_little_beside_a_gap_is_not_to_be_adopted():
    little, much = (row({"x": 2.0, "v": 1.0}, {"x": x, "v": 1.0}) for x in (1.7, 0.5))
    pair, own = ("sensor_delay:psi", "coupling:p<-phi"), ("sensor_delay:psi",)
    left, wide = ([Remainder("x", error=e, floor=1.0)] for e in (1.5, 3.0))
    why = objection((little,), (), own, [pair], left)
    assert holds(why, "sensor_delay:psi gains little", "can't be told from coupling:p<-phi")
    assert not objection((little,), (), own, [pair])  # nothing else is wrong
    assert not objection((much,), (), own, [pair], left)
    assert not objection((little,), (), own, [], left)
    why = objection((little,), (), ("periodic:p",), [], wide)
    assert holds(why, "beside the gap that remains, periodic:p gains little")
    assert not objection((much,), (), ("periodic:p",), [], wide)
    assert not objection((little,), (), (*own, "delay:u"), [pair], left)


def test_whole_trials_that_get_worse_are_contested_whatever_one_state_loses_sooner():
    short = row({"x": 0.2, "v": 0.1}, {"x": 0.05, "v": 0.3})
    whole = row({"x": 2.0, "v": 0.5}, {"x": 3.0, "v": 0.6}, whole_trial=True, horizon_s=60.0)
    assert not outweighed((short,))
    assert outweighed((short, whole)) and "worse for x" in worsened((short, whole))
    assert objection((short, whole), (), ("delay:u",))
    assert not outweighed((replace(short, drowned=True), replace(whole, with_effects=whole.crude)))


def _claiming(*effects, **more):
    hypothesis = SimpleNamespace(effects=effects)
    names = tuple(effect.name for effect in effects)
    return _claims(best=SimpleNamespace(hypothesis=hypothesis), names=names, **more)


def test_numbers_of_the_model_are_fitted_those_beside_adopted_effects_adopted():
    """`next:` says so, and the sentence above it."""
    names = ("mass", "viscous_friction_v_k")
    data = SimpleNamespace(model=SimpleNamespace(param_names=names))

    def said(*off, adopted=("viscous_friction:v",)):
        blamed = tuple(SimpleNamespace(index=names.index(name)) for name in off)
        claims = _claiming(data=data, blamed=blamed, moved=blamed)
        return next_trial(claims, "", (), adopted=adopted)

    fit = said("mass", adopted=())
    assert "fit" in fit and "adopt" not in fit
    for off in (("mass",), names, names[1:]):
        assert said(*off).endswith("adopt the claimed effects.")
    one = _claiming(Library().effect("parameter:mass", cart_task().model))
    assert next_trial(one, "", ()) == fit


def test_predictions_that_run_away_are_compared_with_nothing():
    """Whole trials of an unstable plant, open loop: 4e5 m says nothing, nor do half of them."""
    second = row({"x": 0.2, "v": 0.5}, {"x": 0.1, "v": 0.4}, {"x": 0.1, "v": 0.4})
    away = dict.fromkeys(("crude", "with_effects", "noise_floor"), ("x",))
    far = {"x": 7e5, "v": 0.5}, {"x": 4e5, "v": 0.4}, {"x": 4e3, "v": 0.4}
    whole = row(*far, whole_trial=True, horizon_s=40.0, runs_away=away)
    assert not whole.tells("x", "crude") and whole.tells("v", "crude")
    assert rest((second, whole)) == "" and telling((second, whole)) is second
    assert worsened((second, replace(whole, with_effects={"x": 9e5, "v": 0.4}))) == ""
    assert "x" in runaway((second, whole)) and not runaway((second,))
    named = SimpleNamespace(causes=("parameter:k",))
    table, _ = error_table(
        SimpleNamespace(no_cause=False, prediction_error=(second, whole), verdict=named)
    )
    assert next(cells[1:-1] for cells in table if "whole" in cells[0]) == ("diverges",) * 3
    assert holds(rest((second, replace(whole, runs_away={}))), "x", "100 times", "whole trials")


def test_a_slow_plant_is_spoken_of_by_whole_trials():
    """A second ahead, what heats up over an hour is predicted by any model."""
    second = row({"x": 0.02}, {"x": 0.017})
    whole = row({"x": 5.0}, {"x": 0.3}, whole_trial=True, horizon_s=3600.0)
    assert telling((second, whole)) is whole
    assert holds(improvement((second, whole)), "0.30 m", "5.0 m")
    quick = row({"x": 0.2}, {"x": 0.08})
    assert telling((quick, whole)) is quick and "80 mm" in improvement((quick, whole))
    for rows, told in (((second, whole), True), ((quick, whole), False)):  # as in the sentence
        found = SimpleNamespace(
            no_cause=False, prediction_error=rows, verdict=SimpleNamespace(causes=("b",))
        )
        table, _ = error_table(found, whole_trials=False)
        assert any("whole trial" in cells[0] for cells in table) is told
    assert telling((whole,)) is None and telling(()) is None


def test_the_same_figures_are_not_shown_twice():
    alike = row({"x": 0.02518153, "v": 0.5}, {"x": 0.02518557, "v": 0.5})
    better = row({"x": 0.02518153, "v": 0.5}, {"x": 0.024, "v": 0.5})
    for one, causes, columns in ((alike, (), 1), (better, (), 2), (alike, ("b",), 2)):
        found = SimpleNamespace(
            no_cause=False, prediction_error=(one,), verdict=SimpleNamespace(causes=causes)
        )
        assert len({"crude", "now", "as diagnosed"} & {*error_table(found)[1]}) == columns
        found.no_cause = True  # of one short log: how well the model predicts, and no more
        assert "as diagnosed" not in error_table(found)[1] and "crude" in error_table(found)[1]


def test_nothing_is_said_where_nothing_lost_or_only_within_the_noise():
    assert worsened(()) == ""
    assert worsened((row({"x": 0.2}, {"x": 0.205}),)) == ""
    slight = row({"x": 0.2, "v": 0.5}, {"x": 0.21, "v": 0.5})  # nothing gains as much
    assert outweighed((slight,)) and holds(worsened((slight,)), "worse", "210 mm", "200 mm")
    paid = row({"x": 0.2, "v": 0.5}, {"x": 0.21, "v": 0.4})
    assert not outweighed((paid,)) and worsened((paid,)) == ""
    assert worsened((row({"x": 0.02}, {"x": 0.04}, {"x": 0.05}),)) == ""
    assert worsened((row({"x": 0.02, "v": 0.1}, {"x": math.nan, "v": 0.1}),)) == ""


def _claims(**more):
    known = SimpleNamespace(no_cause=False)
    return SimpleNamespace(**{"known": known, "names": (), "blamed": (), "one_clock": (), **more})


def test_down_to_the_noise_is_said_at_the_floor_alone():
    floor = {"x": 0.1, "v": 0.1}

    def said(after, **more):
        rows = (row(after, after, floor, **more),)
        return verdict(_claims(), (), (), (), rows, ()).sentence

    assert "down to the noise" in said({"x": 0.12, "v": 0.1})
    above = said({"x": 0.17, "v": 0.1})
    assert "1.7 times" in above and "down to the noise" not in above
    assert "1 %" in said({"x": 0.17, "v": 0.1}, outset={"x": 17.0, "v": 9.0})


def test_what_noise_of_few_repeats_does_not_tell_is_no_explanation_down_to_the_noise():
    rows = (row({"x": 0.31, "v": 0.1}, {"x": 1.6e-3, "v": 0.1}, {"x": 9.1e-4, "v": 0.1}),)
    few = (replace(rows[0], floor_unsure=0.41),)
    assert "1.8 times" in rest(rows) and not in_doubt(rows) and not rest(few)
    said = explained(few)
    assert "down to the noise" not in said
    assert holds(said, "1.6 mm", "0.91 mm", "1.8 times", "to a factor of 3.4")
    assert "down to the noise" not in explained((row({"x": 0.1}, {"x": 0.1}, {"x": math.nan}),))


def test_a_leftover_within_the_noise_is_stated_by_what_tells_it_from_noise():
    left = Remainder("v", 0.031, "m/s^2", 12.0, Region("|w| > 0.66", 0.8, 0.3, "rad/s"))
    within = replace(left, error=0.0041, floor=0.004, horizon_s=1.0, error_unit="m/s")
    for one in (within, replace(within, floor_at_most=True)):
        said = one.sentence()
        assert holds(said, "0.031 m/s^2", "|w| > 0.66 rad/s", "noise")
        assert "at most that" not in said
    above = replace(within, error=0.041).sentence()
    assert holds(above, "0.041 m/s", "noise: 0.0040 m/s") and "may all be" not in above


def test_what_a_cause_is_worth_is_the_same_in_the_sentence_and_in_the_table():
    effect = Library().effect("viscous_friction:v", cart_task().model)
    k = {"k": Estimate(0.3, unit="1/s")}
    best = SimpleNamespace(hypothesis=SimpleNamespace(effects=(effect,)))
    claims = _claims(
        best=best, moved=(), parameters=dict, with_rivals=dict, data=SimpleNamespace(model=None)
    )
    claims.data.model = SimpleNamespace(params={}, param_names=[])
    credit = (Credit(effect.name, 0.926, times=12.3), Credit("calibration", 0.074, times=1.222))
    ranked = (Ranked(effect.name, k, claimed=True),)
    said = verdict(claims, ranked, (), (), (), credit)
    assert "(without this, errors are 12 times as large)" in said.sentence
    assert "(without this, errors are 22 % larger)" in said.sentence
    rows, header = effect_table(Diagnosis(said, ranking=ranked, credit=credit))
    assert header[1] == "without" and [row[1] for row in rows] == ["+22 %", "12 times"]
    assert as_large(1.0003) == "hardly larger" and larger(1e5) == "over 1,000 times"
    old = replace(credit[0], times=float("nan"))  # of an older version
    assert with_worth("late", [old]) == "late" and larger(old.times) == ""


def test_neither_a_crash_nor_a_log_by_hand_is_to_be_repeated():
    seen = Unconfirmed("patch:v", trial="t0001", region=Region("v > 2"))
    assert "Repeat trial t0001" in next_trial(_claims(), "", (), (seen,))
    said = {why: next_trial(_claims(), "", (), (seen,), (), {"t0001": why}) for why in (LOG, LOST)}
    assert all("Repeat" not in text and "v > 2" in text for text in said.values())
    assert "gentler" in said[LOST] and "gentler" not in said[LOG]


def test_what_two_logs_by_hand_show_needs_no_third():
    seen = Unconfirmed("delay:v", trial="t1", seen=(2, 8), trials=("t1", "t9"))
    by_hand = next_trial(_claims(), "", (), (seen,), (), {"t1": LOG, "t9": LOG})
    assert holds(by_hand, "No trial is needed", "t1 and t9", "delay:v") and "record" not in by_hand
    for other in ({"t1": LOG}, {"t1": LOG, "t9": LOST}):
        assert "record another" in next_trial(_claims(), "", (), (seen,), (), other)
    once = replace(seen, seen=(1, 8), trials=("t1",))
    assert "record another" in next_trial(_claims(), "", (), (once,), (), {"t1": LOG, "t9": LOG})


def test_a_sensor_that_may_be_late_or_filtered_is_told_as_both():
    alike = (
        Likeness("sensor_lag:v", "sensor_delay:v", 0.995),
        Likeness("sensor_delay:u", "sensor_lag:u", 0.991),
        Likeness("sensor_delay:x", "sensor_lag:x", 0.9),
        Likeness("delay:a", "first_order_lag:a", 0.99),
    )
    names = ["sensor_lag:v", "sensor_delay:u", "sensor_delay:x", "delay:a"]
    (both,) = _late_or_filtered(alike, names)
    assert holds(both, "those of v and u are", "hardly tell")
    assert holds(*_late_or_filtered(alike, names[:1]), "that of v is")
    assert not _late_or_filtered(alike, names[2:])


def test_a_delay_acts_at_every_place():
    late, patch = (Library().effect(name, car.model) for name in ("delay:throttle", "patch:v"))
    assert _anywhere(late) == ("x", "y") and _anywhere(patch) == ()


def test_no_robot_is_sent_to_a_place_in_time():
    """`record another one that goes where t > 19.1 s`"""
    late = Region("t > 19.1", unit="s")
    seen = Unconfirmed("patch:v", "a patch", trial="t6", start=23.24, end=26.16, region=late)
    for why in (LOG, LOST):
        said = next_trial(_claims(), "", (), (seen,), (), {"t6": why})
        assert "t >" not in said and holds(said, "t6 does from 23.2 to 26.2 s")
    assert "19.1" not in seen.sentence()  # it tells its time already
    left = Remainder("x", 0.1, "m/s", region=late)
    assert "mostly after 19.1 s" in left.sentence()
    early = replace(late, when="t < 2", unit="s").phrase
    assert (
        early == "in the first 2 s" and Region("|v| > 2", unit="m/s").phrase == "where |v| > 2 m/s"
    )


def test_headings_are_spoken_of_where_there_are_some():
    def advice(model):
        claims = _claims(data=SimpleNamespace(model=model))
        return next_trial(claims, "", (("viscous_friction:v", "sensor_bias:v"),))

    assert "heading" in advice(car.model)
    assert "heading" not in advice(cart_task().model) + advice(pendulum.model)


def test_what_ended_early_left_safety_or_ran_far_is_lost():
    task = cart_task()
    H, n = task.horizon, task.model.n

    def ran(name, states):
        inputs = np.zeros((len(states) - 1, task.model.m))
        names = task.model.state_names, task.model.input_names
        return Trial(states, inputs, task.dt, *names, id=name, candidate=f"c{name}")

    good = np.where(np.isfinite(task.target), task.target, 0.0).reshape(H + 1, n)
    trials = [ran("good", good), ran("off", good + 0.1), ran("early", good[: H // 2])]
    trials.append(ran("far", good + 50.0 * np.linspace(0, 1, H + 1)[:, None]))
    assert unrepeatable(task, trials) == {"early": LOST, "far": LOST}
    fenced = replace(task, safety_high=np.array([float(good[:, 0].max()) + 0.05, np.inf]))
    assert list(unrepeatable(fenced, trials)) == ["off", "early", "far"]
    assert unrepeatable(task, [replace(trials[2], candidate="")]) == {"early": LOG}
    longer = np.vstack([good, 50.0 + good])  # ran for the target of before
    assert list(unrepeatable(task, [*trials, ran("longer", longer)])) == ["early", "far"]


def test_a_noise_of_which_only_a_bound_is_known_is_told_as_one():
    def said(after, floor, bound=True):
        rows = (row({"x": 1.0}, {"x": after}, {"x": floor}, floor_at_most=bound),)
        return verdict(_claims(), (), (), (), rows, ()), open_noise(rows)

    unsure = row({"x": 1.0}, {"x": 0.9}, {"x": 0.89}, floor_at_most=True)
    unknown, state = said(0.9, 0.89)
    assert unknown.kind == "unknown" and state == "x"
    assert holds(unknown.sentence, "misses x by 900 mm", "noise is not known: repeat one run")
    assert "890 mm" not in unknown.sentence and "explains the data" not in unknown.sentence
    mended = verdict(_claims(), (), (), (), (unsure,), (), adopted=("viscous_friction:v",))
    assert mended.kind == "none"  # after an adoption, "unknown - No known effect" was an alarm
    assert mended.sentence.startswith("Nothing more is found beside what was adopted: 1 s ahead")
    assert "noise is not known: repeat one run" in mended.sentence
    known, state = said(0.9, 0.89, bound=False)
    assert known.kind == "none" and "890 mm" in known.sentence and not state
    assert "9 times the most that can be noise" in said(0.9, 0.1)[0].sentence
    repeats = row({"x": 1.0}, {"x": 0.9}, {"x": 0.7}, floor_from=AT_MOST, floor_unsure=0.3)
    mended = verdict(_claims(), (), (), (), (repeats,), (), adopted=("viscous_friction:v",))
    assert mended.kind == "none" and "explains the data" not in mended.sentence
    assert holds(mended.sentence, "Nothing more is found", "900 mm (noise: at most 700 mm)")
    assert "the scatter of the repeats holds what the model misses" in mended.sentence
    left = Remainder("x", error=0.9, floor=0.1, horizon_s=1.0, error_unit="m", floor_at_most=True)
    assert "at most 100 mm" in left.sentence()


def test_repeats_are_asked_for_where_there_are_none_as_they_can_be_made():
    task = cart_task()
    names = task.model.state_names, task.model.input_names
    H, n, m = task.horizon, task.model.n, task.model.m

    def ran(k, candidate):
        x, u = np.full((H + 1, n), 0.1 * k), np.full((H, m), 0.01 * k)
        return Trial(x, u, task.dt, *names, id=f"t{k}", candidate=candidate)

    single = [ran(1, "c0001"), ran(2, "c0002")]
    best = max(single, key=task.utility).candidate
    assert holds(another_look(task, single, "x"), f"Run {best} twice more", "gap in x")
    three = [*single, ran(3, "c0002")]
    twice = another_look(task, three, "x", "where |v| > 1")
    assert "twice" not in twice and holds(twice, "x", "|v| > 1")
    # it asked to move x in another way, and a student asked how: by hand? which way? how far?
    part = Part("t0001", 0.0, 0.5, 0.87)  # where a finger held the ball
    held = another_look(task, three, "x", part=part)
    assert holds(held, "Look at t0001, from 0 to 0.5 s", "discard t0001", "if not, run a trial")
    left = Remainder("x", error=0.9, floor=0.1, horizon_s=1.0, error_unit="m", part=part)
    assert left.sentence().endswith("(noise: 100 mm), 87 % of it in t0001, from 0 to 0.5 s")
    begun = another_look(task, three, "x", begins="v")  # it was to move y where v was 100 % off
    assert holds(begun, "moves v in another way", "gap in x (most of the one-step errors are in v)")
    anyhow = another_look(task, three, "x")
    assert holds(anyhow, "in another way", "by hand", "steps", "sweeps", "inside", "manoeuvre")
    driven = another_look(task, [*three, ran(4, "")], "x")
    assert holds(driven, "by hand, as in t4") and "manoeuvre" not in driven
    noise = another_look(task, single, "x", noise=True)  # no gap was named: it asked for `the gap`
    assert holds(noise, f"Run {best} twice more", "in x is noise") and "gap" not in noise
    by_hand = another_look(task, [ran(1, ""), ran(2, "")], "x")
    assert "same inputs" in by_hand and "best" not in by_hand
    assert "same inputs" not in another_look(task, [ran(1, ""), ran(1, "")], "x")
    assert next_trial(_claims(), by_hand, ()) == by_hand


def test_an_adopted_effect_that_may_be_none_is_told():
    adopted = ("offset:u", "joint_friction:t1<-q1")
    known = {
        "offset_u_c": Estimate(0.05, 0.079, None, "m/s^2"),
        "m": Estimate(0.1, 1.0, None, "kg"),
        "joint_friction_t1_from_q1_c": Estimate(0.0, 0.1, None, "N m"),
        "joint_friction_t1_from_q1_b": Estimate(0.2, 0.01, None, "N m s/rad"),
    }
    (told,) = _unneeded(known, adopted)
    assert holds(told, "offset:u", "c = 0.0500 +- 0.079 m/s^2", "remove it from [model] effects")
    assert not _unneeded({"offset_u_c": Estimate(0.05, 0.01, None, "m/s^2")}, adopted)
    assert not _unneeded(known, ())
