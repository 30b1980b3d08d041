"""Run the command line in tests, in this process or as one of its own."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Done:
    """The result of a command: exit code, stdout and stderr."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Return stdout parsed as one strict JSON document."""
        return json.loads(self.out, parse_constant=_no_constant)


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


def grounded(*args: object) -> Done:
    """Run `grounded ARGS` in this process."""
    from grounded_cli import main as module

    out, err = io.StringIO(), io.StringIO()
    before, sys.argv = sys.argv, ["grounded", *map(str, args)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            module.main()
    except SystemExit as stop:
        return Done(int(stop.code or 0), out.getvalue(), err.getvalue())
    finally:
        sys.argv = before
    raise AssertionError("main() always exits")


COMMAND = [sys.executable, "-c", "from grounded_cli.main import main; main()"]


def process(*args: object, cwd: Path | None = None, **env: str) -> Done:
    """Run `grounded ARGS` as a process."""
    done = subprocess.run(
        [*COMMAND, *map(str, args)],
        capture_output=True,
        text=True,
        cwd=cwd,
        env=os.environ | env,
        timeout=120,
        check=False,
    )
    return Done(done.returncode, done.stdout, done.stderr)


def plain(text: str) -> str:
    """Remove -C DIR from the commands in a text, and join commands broken over lines."""
    text = re.sub(r" \\\n +", " ", text)
    return re.sub(r"grounded\s+-C\s+\S+\s+", "grounded ", text)
