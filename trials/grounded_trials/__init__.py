"""The disk: logs, the store, the workspace, reports. A file is data, never code.

`from grounded_trials import Workspace` is the front door (`door.py`): a method for every command.

workspace/  START HERE: a folder with a task, and what each command does in it
starting/   how a workspace is made: of a log, a model, an example
store/      our own files, content-addressed
logs/       foreign logs: which signal is which state, samples on the control grid
formats/    bytes of log files as arrays
report/     text, page, pictures, recording

`challenge.py` writes and scores blind cases on the disk;
`toml_table.py` takes a user's table apart key by key; `wording.py` puts numbers and units in words.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from grounded_trials.door import Workspace

__all__ = ["Workspace"]


def __getattr__(name: str) -> Any:
    """Imports the door when it is opened: `import grounded_trials` alone costs nothing."""
    if name != "Workspace":
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    from grounded_trials.door import Workspace

    return Workspace
