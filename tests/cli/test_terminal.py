"""Words on a terminal: columns, labels and remarks within 80 columns."""

import re
import time
from dataclasses import replace

import pytest

from grounded.diagnosis.error_report import RulerRow
from grounded.diagnosis.report import Diagnosis, Verdict
from grounded_cli.console import terminal
from grounded_cli.console.terminal import field, harmless, names_in, remark, sparkline, table


def test_a_narrow_table_has_one_line_of_names():
    assert harmless(table([("a", "1.0"), ("bb", "12.0")], ("x", "value"))) == (
        "x   value\na     1.0\nbb   12.0"
    )


def test_a_wide_table_breaks_the_names_of_its_columns():
    names = ("manoeuvre", *(f"improvement with scatter, level {k}" for k in range(6)))
    rows = [("turn", *["98.9 % ± 0.1"] * 6)]
    text = harmless(table(rows, names))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 110 and len(lines) > 2
    assert lines[-1].split()[0] == "turn" and "manoeuvre" in lines[-2]
    narrow = table([("turn", *["98.9 %"] * 4)], names[:5])
    assert max(map(len, harmless(narrow).splitlines())) <= 80


def test_a_table_without_rows_or_names():
    assert harmless(table([], ("x", ""))) == "x"


@pytest.mark.parametrize("text", ["99.7 % of it " * 20, "x" * 200, "", "a-b " * 60])
def test_a_label_keeps_its_text_together(text):
    lines = field("gap", text).splitlines()
    assert lines[0].startswith("gap")
    assert all(not line.strip().startswith("%") for line in lines)
    assert " ".join("\n".join(lines).split()) == " ".join(f"gap {text}".split())
    if "x" * 100 not in text:
        assert max(map(len, lines)) <= 80


def test_a_remark_is_wrapped(capsys):
    remark("warning", "the run ended after 48 of 60 steps " * 5)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("warning: the run") and max(map(len, lines)) <= 80
    assert all(line.startswith("  ") for line in lines[1:])


def test_names_of_a_list():
    assert names_in(" a, b,,a ") == ["a", "b"] and names_in(None) == []


@pytest.mark.parametrize("columns", [60, 72, 80])
def test_a_table_is_as_wide_as_the_terminal(monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", str(columns))
    rows = [("delay:steering+throttle", "1,348", "d = 0.0179 +- 6.3e-05 s, k = 0.2 m/s")]
    text = harmless(table(rows * 2, ("effect", "evidence [nats]", "its value after the fit")))
    assert max(map(len, text.splitlines())) <= columns
    assert "0.0179 +- 6.3e-05 s," in text  # a number keeps its spread and its unit
    wide = harmless(table([("state", *["0.1234567"] * 9)] * 2, [f"name{k}" for k in range(10)]))
    assert max(map(len, wide.splitlines())) <= columns and wide.count("state") > 2
    assert max(map(len, field("gap", "1.5 m off " * 30).splitlines())) <= columns


def test_bars_say_their_scale():
    assert sparkline([-2.0, -1.0]).startswith("▁█  -2.000 to -1.000")
    assert "logarithmic" in sparkline([-100.0, -1.0, float("-inf")])
    assert sparkline([-100.0, -1.0, float("-inf")])[2] == "x"


def test_colour_means_something_and_takes_no_room():
    coloured, plain = table([("c1", "crashed")], ("id", "")), "id\nc1  crashed"
    assert harmless(coloured) == plain and "\033[1;31mcrashed" in harmless(coloured, coloured=True)


def test_evidence_that_is_not_known_is_a_dash(capsys):
    from grounded.diagnosis.report import Ranked
    from grounded_cli.diagnose import _effects

    row = Ranked("parameter:m", claimed=True)
    _effects(Diagnosis(Verdict("several", ("parameter:m",)), ranking=(row,)), details=True)
    told = capsys.readouterr().out
    assert "parameter:m" in told and "nan" not in told


def test_a_delay_of_a_log_with_rows_is_told_where_its_spread_comes_from(capsys):
    """A crane's: +- 10 ms, with nothing on the 20 ms between the rows; the scatter was 0.5 ms."""
    from grounded.diagnosis.report import Estimate, Made, Ranked
    from grounded_cli.diagnose import _effects

    row = Ranked("delay:u", {"d": Estimate(0.0297, 0.01, unit="s")}, claimed=True)
    said = Diagnosis(Verdict("effect", ("delay:u",)), ranking=(row,), made=Made(rows_s=0.02))
    _effects(said, details=False)
    assert "half of the 0.02 s between rows" in " ".join(capsys.readouterr().out.split())
    _effects(replace(said, made=Made()), details=False)
    assert "between rows" not in " ".join(capsys.readouterr().out.split())
    _effects(replace(said, made=Made(interpolated_s=0.0025)), details=False)
    assert "+- of times: at least 2.5 ms" in " ".join(capsys.readouterr().out.split())


def test_a_diagnosis_lists_rivals_and_whole_trials_only_in_its_details(capsys):
    from grounded.diagnosis.report import Ranked
    from grounded_cli.diagnose import _show

    claimed, tied, rival = "delay:u", "first_order_lag:u", "offset:v"
    ranking = (Ranked(claimed, claimed=True), Ranked(tied), Ranked(rival))
    found = Diagnosis(
        Verdict("effect", (claimed,)),
        ranking=ranking,
        indistinguishable=((claimed, tied),),
        prediction_error=(_row(1.0), _row(8.0, whole_trial=True)),
    )
    for details in (False, True):
        _show(found, {}, details=details)
        out = capsys.readouterr().out
        assert claimed in out and tied in out and "v, 1 s ahead" in out
        assert (rival in out) == ("v, whole trial" in out) == details


def _row(horizon_s, **more):
    return RulerRow(
        horizon_s,
        unit_by_channel={"v": "m/s"},
        crude={"v": 0.3},
        with_effects={"v": 0.1},
        noise_floor={"v": 0.1},
        **more,
    )


def test_a_long_command_says_its_stage_in_a_log_too_now_and_then(capsys, monkeypatch):
    """Eighteen minutes of nothing: a first user believed that it hung."""
    monkeypatch.setattr(terminal, "EVERY", 0.5)
    with terminal.stages() as tell:
        tell("fitting")
        tell("comparing effects, 40 %")
        time.sleep(0.8)  # also while nothing is told: `next` was silent for four minutes
        tell("")
        time.sleep(0.6)
    assert capsys.readouterr().err == "comparing effects, 40 % ...\n"


def test_a_stage_that_lasts_is_not_said_twice_in_the_same_words(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "EVERY", 0.4)
    with terminal.stages() as tell:
        tell("planning")
        time.sleep(1.0)
    first, second = capsys.readouterr().err.splitlines()
    assert first == "planning ..." and re.fullmatch(r"planning, \d s so far \.\.\.", second)
    with terminal.stages() as tell:
        tell("scan (one more effect), 13 min so far, about 2 min left")
        time.sleep(1.0)
    _, second = capsys.readouterr().err.splitlines()  # `13 min so far, 810 s so far`
    assert re.fullmatch(r"scan \(one more effect\), \d s so far \.\.\.", second)


def test_errors_of_what_falls_over_by_itself_are_said_to_tell_little_farther_ahead():
    from grounded_trials.report.diagnosis_notes import held_out

    rows = (RulerRow(0.1), RulerRow(0.5), RulerRow(1.0))
    assert "0.5 s" not in held_out(Diagnosis(Verdict("none"), prediction_error=rows))
    fallen = Diagnosis(
        Verdict("none"), prediction_error=(*rows[:2], replace(rows[2], drowned=True))
    )
    assert "beyond 0.5 s" in held_out(fallen)
