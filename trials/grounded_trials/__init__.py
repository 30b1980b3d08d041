"""File access: logs, the store, the workspace, reports. A file is data and is never executed.

The entry point is `from grounded_trials import Workspace` (`door.py`), with a method for every
command.

workspace/  START HERE: a folder with a task, and what each command does in it
starting/   making a workspace from a log, a model or an example
store/      grounded's own files, content-addressed
logs/       foreign logs: mapping signals to states, resampling to the control interval
formats/    decoding the bytes of log files into arrays
report/     text, page, pictures, recording

`challenge.py` writes and scores the blind challenge; `toml_table.py` reads a user's TOML table key
by key; `wording.py` formats numbers and units.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from grounded_trials.door import Workspace

__all__ = ["Workspace"]


def __getattr__(name: str) -> Any:
    """Import `Workspace` on first access, so that `import grounded_trials` stays fast."""
    if name != "Workspace":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from grounded_trials.door import Workspace

    return Workspace
