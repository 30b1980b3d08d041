"""Shared fixtures: a cache of compiled models for the session, workspaces, the shared data."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from grounded_trials.workspace.folder import Folder
from reported import car, cart, learnt
from shared_data import DATA

__all__ = ["car", "cart", "learnt"]  # fixtures of all tests

EXTRAS = {
    "view": "rerun",
    "report": "jinja2",
    "notebook": "plotly",
    "png": "matplotlib",
}
# Files with tests of more than 20 s: they go first, so that no worker waits at the end for one.
LONG = ("test_notebooks", "test_docs", "test_experiments_paper", "test_udp_robot")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "extra(*names): skipped where such an extra is missing")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.path.stem not in LONG)  # the others stay in their order


def pytest_runtest_setup(item: pytest.Item) -> None:
    names = [name for mark in item.iter_markers("extra") for name in mark.args]
    missing = [name for name in names if find_spec(EXTRAS[name]) is None]
    if missing:
        pytest.skip(f"the extra '{missing[0]}' is not installed ({EXTRAS[missing[0]]})")


@pytest.fixture(scope="session", autouse=True)
def _cache_of_this_session(tmp_path_factory: pytest.TempPathFactory):
    """Compiled models go to a folder of this session, here, in its workers and in subprocesses."""
    before = os.environ.get("GROUNDED_CACHE")
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    os.environ["GROUNDED_CACHE"] = str(folder / "kernels")
    yield
    if before is None:
        del os.environ["GROUNDED_CACHE"]
    else:
        os.environ["GROUNDED_CACHE"] = before


@pytest.fixture(scope="session")
def shared() -> Path:
    """The folder of real data, ../shared/data; tests that need it skip where it is missing."""
    if DATA is None:
        pytest.skip("../shared/data is not there (GROUNDED_SHARED names its folder)")
    return DATA


@pytest.fixture
def workspace_of(tmp_path: Path) -> Callable[..., Folder]:
    """Makes a workspace from an example: the cart of `workspaces` unless another is named."""
    from workspaces import make

    def made(example: str = "cart", folder: str = "w", **changes: str) -> Folder:
        return make(tmp_path / folder, example, **changes)

    return made
