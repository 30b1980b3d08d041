"""grounded view: the recording in the Rerun viewer."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import click

from grounded_cli.options import in_workspace, open_workspace
from grounded_cli.terminal import progress, say


@click.command("view")
@in_workspace
def command() -> None:
    """Open the recording in the Rerun viewer: paths, states, inputs, bias, trial by trial.

    The file reports/recording.rrd is written first. Without a screen, copy it to a computer that
    has one (extra `view`) and open it there: rerun recording.rrd
    """
    workspace = open_workspace()
    from grounded_trials.report.reporting import save_recording

    with progress("writing the recording"):
        path = save_recording(workspace)
    _open(path)


def _open(path: Path) -> None:
    """Starts the viewer and leaves it running.

    Raises:
        GroundedError: if there is none, or it ends at once.
    """
    from grounded.errors import GroundedError

    by_hand = f"copy {path} to a computer with a screen and open it there: rerun {path.name}"
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        raise GroundedError(f"there is no screen here: {by_hand}")
    beside = Path(sys.executable).with_name("rerun")
    program = str(beside) if beside.exists() else shutil.which("rerun")
    if program is None:
        raise GroundedError(
            "the viewer is missing: pip install '.[view]' in grounded's own folder, then: "
            f"rerun {path}"
        )
    # A viewer of its own that no other machine can reach: it would listen on every address.
    words = [program, "--new", "--bind", "127.0.0.1", str(path)]
    viewer = subprocess.Popen(words, stdout=2, start_new_session=True)
    try:
        code = viewer.wait(timeout=2.0)
    except subprocess.TimeoutExpired:
        viewer.returncode = 0  # it goes on without us
        say(f"{path} is open in the viewer")
        return
    if code != 0:
        raise GroundedError(f"the viewer ended with exit code {code}: {by_hand}")
