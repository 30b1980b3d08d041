"""Words on a terminal: columns, labels and remarks within 80 columns."""

import time

import pytest

from grounded_cli.console import terminal
from grounded_cli.console.terminal import field, harmless, table


def test_a_wide_table_breaks_the_names_of_its_columns():
    names = ("manoeuvre", *(f"improvement with scatter, level {k}" for k in range(6)))
    rows = [("turn", *["98.9 % ± 0.1"] * 6)]
    text = harmless(table(rows, names))
    lines = text.splitlines()
    assert max(map(len, lines)) <= 110 and len(lines) > 2
    assert lines[-1].split()[0] == "turn" and "manoeuvre" in lines[-2]
    narrow = table([("turn", *["98.9 %"] * 4)], names[:5])
    assert max(map(len, harmless(narrow).splitlines())) <= 80


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


def test_a_long_command_says_its_stage_in_a_log_too_now_and_then(capsys, monkeypatch):
    monkeypatch.setattr(terminal, "EVERY", 0.5)
    with terminal.stages() as tell:
        tell("fitting")
        tell("comparing effects, 40 %")
        time.sleep(0.8)  # also while nothing is told: `next` was silent for four minutes
        tell("")
        time.sleep(0.6)
    assert capsys.readouterr().err == "comparing effects, 40 % ...\n"
