"""What a file says it is, from its first records: one of ours, or somebody else's log."""

from __future__ import annotations

from pathlib import Path

from grounded.errors import GroundedError
from grounded_trials.log_files import open_log
from grounded_trials.mcap_records import Messages, Metadata
from grounded_trials.mcap_walk import read_records


def kind_of(path: Path) -> str:
    """The `format` that a file of ours states ahead of its messages, "" for any other file.

    Damage is not judged here: whoever reads the file does that.
    """
    try:
        with open_log(path) as stream:
            for record in read_records(stream, str(path)):
                if isinstance(record, Metadata) and record.name == "grounded":
                    return record.data.get("format", "")
                if isinstance(record, Messages):
                    return ""
    except GroundedError:
        return ""
    return ""
