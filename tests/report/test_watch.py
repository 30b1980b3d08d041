"""report --watch: the page is written again when a trial comes in, and told to reload."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from grounded.errors import GroundedError
from grounded_trials import Workspace
from reported import cart

__all__ = ["cart"]
pytestmark = pytest.mark.extra("report")


@pytest.fixture
def copy(cart: Path, tmp_path: Path) -> Path:
    shutil.copytree(cart, tmp_path / "w", ignore=shutil.ignore_patterns("t0001-*"))
    return tmp_path / "w"


def _revisions(folder: Path) -> tuple[str, str]:
    page = (folder / "reports" / "report.html").read_text()
    stamp = (folder / "reports" / "watched.svg").read_text()
    found = re.search(r'data-watched="(\d+)"', page), re.search(r'width="(\d+)"', stamp)
    assert found[0] and found[1]
    return found[0][1], found[1][1]


def test_a_new_trial_makes_a_new_page(cart, copy):
    watching = Workspace(copy).watch(every=0.01)
    first = next(watching)
    before, stamp = _revisions(copy)
    assert before == stamp
    (more,) = cart.glob("trials/t0001-*")
    shutil.copy2(more, copy / "trials" / more.name)
    second = next(watching)
    assert len(second.findings.runs) == len(first.findings.runs) + 1
    after, stamp = _revisions(copy)
    assert after == stamp != before


def test_a_file_half_edited_is_waited_for(copy):
    said: list[GroundedError] = []
    config = copy / "grounded.toml"
    whole = config.read_text()

    def mend(error: GroundedError) -> None:
        said.append(error)
        config.write_text(whole)

    watching = Workspace(copy).watch(every=0.01, trouble=mend)
    next(watching)
    page = (copy / "reports" / "report.html").read_bytes()
    config.write_text(whole + "\n[task")
    assert next(watching).findings.runs and len(said) == 1
    assert (copy / "reports" / "report.html").read_bytes() != page
