"""Where to correct an instrument finding: in [log], or in a program.

A finding refers to signals as they were read, so its correction is combined with the keys of [log]
that read them: scales multiply, delays add.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from grounded import findings as said
from grounded.accounts.finding import Finding, late_effects
from grounded.trial import Trial
from grounded_trials.logs.log_files import digest_of
from grounded_trials.logs.log_table import misread
from grounded_trials.store.store import hash_file
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.identity import sha256
from grounded_trials.workspace.readings import UNCHANGED, Reading, readings_of


def hashed(files: Sequence[Path]) -> str:
    """Return the SHA-256 of a log's file, or of the hashes if it has several files."""
    hashes = [hash_file(file) if file.is_file() else digest_of(file) for file in files]
    return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode())


def where_to_mend(
    workspace: Folder, used: Sequence[Trial], findings: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Complete findings with the whole key of [log], or with none if no trial was read by it."""
    about = {one.stored.id: one.meta for one in workspace.trials()}
    fed = workspace.config.task.feedback
    read = [meta for trial in used if "source_sha256" in (meta := about[trial.id])]

    def either(one: Finding) -> said.Finding:  # by whether the robot's program gets it as late
        other = one.said.facts.get("message") if one.said else None
        return said.found("sensor.mend", one.signal, log=one.log, of=other)

    if read:
        strange = misread(workspace.base_model, workspace.log_mapping)
        odd = [Finding(one.about[0], one, "mismatch") for one in strange]
        by = readings_of(read[-1])
        whole = (replace(one, keys=_whole(one, by)) for one in (*odd, *findings))
        return tuple(
            replace(one, mend=either(one)) if fed and one.keys and late_effects([one]) else one
            for one in whole
        )
    return tuple(replace(one, keys={}) if one.corrected else one for one in findings)


def _whole(finding: Finding, by: Mapping[str, Reading]) -> Mapping[str, Any]:
    """Return the whole key of [log] for a finding, combined with the keys used for a trial."""
    keys, now = dict(finding.keys), by.get(finding.signal, UNCHANGED)
    numbers = (now.scale, now.offset, now.delay_s)
    if not all(map(math.isfinite, numbers)) or numbers == (1.0, 0.0, 0.0):
        return keys
    if "scale" in keys:
        offset = float(keys["scale"]) * now.offset + float(keys.get("offset", 0.0))
        keys["scale"] = float(keys["scale"]) * now.scale
        keys |= {"offset": offset} if offset else {}
    if "delay_s" in keys:
        keys["delay_s"] = float(f"{keys['delay_s'] + now.delay_s:.3g}")
    return keys
