"""The folder of the project's shared real data; tests that need it skip without it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


def _find() -> Path | None:
    named = os.environ.get("GROUNDED_SHARED")
    folders = [Path(named)] if named else [p / "shared" for p in Path(__file__).resolve().parents]
    return next((f / "data" for f in folders if (f / "data").is_dir()), None)


SUPPORT = Path(__file__).parent  # helpers of the tests, for subprocesses
DATA = _find()
MISSING = "../shared/data is not there (GROUNDED_SHARED names its folder)"
needs_data = pytest.mark.skipif(DATA is None, reason=MISSING)


def files(pattern: str) -> list[Path]:
    return sorted(DATA.glob(pattern)) if DATA is not None else []


def data(*parts: str) -> Path:
    if DATA is None:
        pytest.skip(MISSING)
    return DATA.joinpath(*parts)
