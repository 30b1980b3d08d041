"""The notebooks in examples/: tidy files without outputs, and every cell of them runs."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[2] / "examples"
BOOKS = sorted(EXAMPLES.glob("*.ipynb"))


def run(name, folder, monkeypatch, since="#", **known):
    """The code cells of a notebook from a heading on, in one namespace, in an empty folder."""
    monkeypatch.chdir(folder)
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    space = {"__name__": "__main__", **known}
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text())["cells"]
    first = next(k for k, cell in enumerate(cells) if cell["source"][0].startswith(since))
    for cell in cells[first:]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{name}:{cell['id']}", "exec"), space)
    return space


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_a_notebook_is_kept_tidy_and_without_outputs(book):
    text = book.read_text()
    document = json.loads(text)
    assert json.dumps(document, indent=1, ensure_ascii=False) + "\n" == text
    for cell in document["cells"]:
        assert cell.get("outputs", []) == [] and cell.get("execution_count") is None
        assert cell["metadata"] == {} and cell["source"]
    ids = [cell["id"] for cell in document["cells"]]
    assert len(ids) == len(set(ids))


def test_the_papers_loop(tmp_path, monkeypatch):
    search = run("paper_loop", tmp_path, monkeypatch)["search"]
    utilities = [tried.utility for tried in search.standing.history]
    assert search.best.utility > 0.5 * utilities[0]  # half of the cost is gone
    assert search.policy is search.best.candidate.policy


@pytest.mark.slow
def test_a_diagnosis(tmp_path, monkeypatch):
    space = run("diagnosis", tmp_path, monkeypatch)
    assert space["found"].effects == ("coulomb_friction:omega",)
    assert space["found"].values("coulomb_friction:omega")["c"] == pytest.approx(1.54, rel=0.1)
    assert space["found"].parameters["m"].value == pytest.approx(1.3, rel=0.05)
    assert (space["folder"] / "reports" / "report.html").exists()
    assert space["machine"] is None


@pytest.mark.slow
def test_table_1(tmp_path, monkeypatch):
    found = run("table1", tmp_path, monkeypatch)["result"].to_json()
    assert [one["seed"] for one in found["runs"]] == [0] and found["improvement"]["mean"] > 0.5
    assert all(one["utilities"][-1] > 1.01 * found["optimum"] for one in found["runs"])
