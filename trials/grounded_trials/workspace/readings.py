"""How [log] reads the signals, and how it read those of the trials.

The metadata of each trial records the keys of [log] by which its signals were read. A trial keeps
its numbers when [log] is changed: its log has to be discarded and ingested again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from grounded.findings import Finding as Said
from grounded.findings import found as said
from grounded.places import heading, position
from grounded_trials.workspace.identity import READ_BY

if TYPE_CHECKING:
    from grounded_trials.logs.log_table import LogMapping
    from grounded_trials.workspace.folder import Folder
    from grounded_trials.workspace.user_files.config import Effects


@dataclass(frozen=True)
class Reading:
    """How [log] reads a signal: its column, and the numbers that correct it."""

    path: str = ""
    scale: float = 1.0
    offset: float = 0.0
    delay_s: float = 0.0


NUMBERS = ("scale", "offset", "delay_s")
UNCHANGED = Reading()
SENSOR_DELAY = "sensor_delay:"  # before the states, in the name of an effect


def readings(mapping: LogMapping | None) -> dict[str, Reading]:
    """Return how [log] reads each signal; {} without [log]."""
    found = {**mapping.states, **mapping.inputs} if mapping else {}
    return {
        name: Reading(spec.path, *(float(getattr(spec, key)) for key in NUMBERS))
        for name, spec in found.items()
    }


def read_by(mapping: LogMapping) -> dict[str, str]:
    """Return the metadata of a trial with how [log] reads each signal, as far as it changes it."""
    found = {
        name: {k: v for k, v in vars(one).items() if k == "path" or v != getattr(UNCHANGED, k)}
        for name, one in readings(mapping).items()
    }
    return {READ_BY: json.dumps(found)}


def readings_of(meta: Mapping[str, str]) -> dict[str, Reading]:
    """Return how [log] read each signal of a trial; {} if its metadata, not trusted, don't say."""
    try:
        return {
            str(name): Reading(
                str(own.get("path", "")),
                *(float(own.get(key, getattr(UNCHANGED, key))) for key in NUMBERS),
            )
            for name, own in json.loads(meta.get(READ_BY, "{}")).items()
        }
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}


def paths_of(meta: Mapping[str, str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the columns from which [log] read some signals of a trial; () if it does not say."""
    known = readings_of(meta)
    found = tuple(known[name].path for name in names if name in known)
    return found if len(found) == len(names) and all(found) else ()


def one_message(workspace: Folder) -> tuple[str, ...]:
    """Return the states of a pose if one message holds them, else none.

    A message has one stamp, so its position and its heading are late together or not at all.
    """
    model, mapping = workspace.base_model, workspace.log_mapping
    pose = [*position(model), *filter(None, [heading(model)])]
    if mapping is None or len(pose) < 2 or not set(pose) <= set(mapping.states):
        return ()
    topics = {mapping.states[name].path.partition(".")[0] for name in pose}
    return tuple(pose) if len(topics) == 1 else ()


# delays that [log] takes out as well as the model


def taken_out(workspace: Folder) -> dict[str, float]:
    """Return the delay of each signal [s] that [log] takes out beyond what it did for the trials.

    A delay_s that the trials were read with is another part of the delay.
    """
    log = readings(workspace.log_mapping)
    metas = [one.meta for one in workspace.whole_trials() if READ_BY in one.meta] if log else []
    before = readings_of(metas[-1]) if metas else {}
    return {n: one.delay_s - before.get(n, UNCHANGED).delay_s for n, one in log.items()}


def twice_in_time(workspace: Folder, effects: Effects | None = None) -> Said | None:
    """Return that [log] now removes delays that the adopted, or other, effects have as well."""
    effects = workspace.config.model.effects if effects is None else effects
    named = {n.removeprefix(SENSOR_DELAY): one for n, one in effects.items() if SENSOR_DELAY in n}
    late = {n: one.get("d", 0.0) for n, one in named.items()}
    gone = taken_out(workspace) if late else {}
    twice = [name for name, d in late.items() if gone.get(name, 0.0) > d / 2 > 0]
    if not twice:
        return None
    keys = tuple(f"[log.state.{name}] delay_s" for name in twice)
    both = tuple(SENSOR_DELAY + name for name in twice)
    return said("plan.delay_twice", *twice, keys=keys, effects=both)
