"""Words on a terminal: columns, labels and remarks within 80 columns."""

import pytest

from grounded_cli.terminal import field, harmless, names_in, remark, table


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
    assert max(map(len, narrow.splitlines())) <= 80


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
