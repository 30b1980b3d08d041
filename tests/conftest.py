"""Shared fixtures: a cache of compiled models for the session, workspaces, the shared data."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from grounded_trials.workspace.folder import Folder
from shared_data import DATA


@pytest.fixture(scope="session", autouse=True)
def _cache_of_this_session(tmp_path_factory: pytest.TempPathFactory):
    """Compiled models go to a folder of this session, here and in subprocesses."""
    before = os.environ.get("GROUNDED_CACHE")
    os.environ["GROUNDED_CACHE"] = str(tmp_path_factory.mktemp("kernels"))
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
