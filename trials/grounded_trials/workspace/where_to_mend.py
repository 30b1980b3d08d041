"""How [log] read the trials, and where to correct an instrument finding: there, or in a program.

The metadata of each trial records the keys of [log] by which its signals were read. A finding
refers to signals as they were read, so its correction is combined with these keys: scales multiply,
delays add. A trial keeps its numbers when [log] is changed: what a diagnosis found in it may be due
to what was corrected there since (`changed_since`), and its log has to be ingested again first.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded import findings as said
from grounded.accounts.finding import SENSOR_DELAY, Finding, late_effects
from grounded.errors import GroundedError, NextCommand
from grounded.places import heading, position
from grounded_trials.store.store import hash_file
from grounded_trials.workspace.identity import READ_BY, StoredTrial, sha256
from grounded_trials.workspace.user_files.task_file import seen_in

if TYPE_CHECKING:
    from grounded.diagnosis.parts import Diagnosis
    from grounded.trial import Trial
    from grounded_trials.logs.log_table import LogMapping
    from grounded_trials.workspace.folder import Folder

PLAIN = {"scale": 1.0, "offset": 0.0, "delay_s": 0.0}  # keys of a signal that is read unchanged


def read_by(mapping: LogMapping) -> dict[str, str]:
    """Return the metadata of a trial with how [log] reads each signal, without keys as in PLAIN."""
    found = {}
    for name, spec in {**mapping.states, **mapping.inputs}.items():
        keys = {key: float(getattr(spec, key)) for key in PLAIN}
        found[name] = {"path": spec.path} | {k: v for k, v in keys.items() if v != PLAIN[k]}
    return {READ_BY: json.dumps(found)}


def _keys_by(meta: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Return the path and the numbers by which [log] read each signal of a trial.

    {} if its metadata, which are not trusted, do not say.
    """
    try:
        return {
            str(name): {"path": str(own.get("path", ""))}
            | {key: float(own.get(key, usual)) for key, usual in PLAIN.items()}
            for name, own in json.loads(meta.get(READ_BY, "{}")).items()
        }
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}


def paths_of(meta: Mapping[str, str], names: Sequence[str]) -> tuple[str, ...]:
    """Return the columns from which [log] read some signals of a trial; () if it does not say."""
    known = _keys_by(meta)
    found = tuple(known[name]["path"] for name in names if name in known)
    return found if len(found) == len(names) and all(found) else ()


def read_otherwise(
    meta: Mapping[str, str], mapping: LogMapping | None, corrected: Collection[tuple[str, str]] = ()
) -> tuple[str, ...]:
    """Return the signals of a trial that [log] reads in another way now.

    Args:
        meta: the trial's metadata.
        mapping: the present [log].
        corrected: signals with a key of theirs that may differ.
    """
    before, found = _keys_by(meta), list[str]()
    for name, spec in {**mapping.states, **mapping.inputs}.items() if mapping else ():
        if (was := before.get(name)) is None:
            continue
        keys = [key for key in PLAIN if (name, key) not in corrected]
        same = all(np.isclose(was[key], getattr(spec, key)) for key in keys)
        if was["path"] not in ("", spec.path) or not same:
            found.append(name)
    return tuple(found)


def changed_since(
    workspace: Folder, diagnosis: Diagnosis, usable: Collection[str]
) -> tuple[str, ...]:
    """Return the signals that [log] reads otherwise than it did for a diagnosis, else ().

    What the diagnosis corrected itself may have been written into [log] since. Once there is a
    trial that was read by the present [log], the others were left as they are on purpose.
    """
    made = diagnosis.made
    if made is None or not workspace.config.log.names():
        return ()
    mapping = workspace.log_mapping
    corrected = {
        (name, key)
        for one in diagnosis.preflight
        for name in one.signal.split("+")
        for key in PLAIN
        if key in one.log
    }
    if any(one.kind == "delay" and one.log for one in diagnosis.preflight):  # maybe of another
        corrected |= {(name, "delay_s") for name in workspace.base_model.state_names}
    found: tuple[str, ...] = ()
    for one in workspace.whole_trials():
        if one.stored.id in usable and READ_BY in one.meta:
            found = read_otherwise(one.meta, mapping, corrected)
            if not found:
                return ()
    return found


def again(
    workspace: Folder, meta: Mapping[str, str], candidate: str, *, waits: bool = False
) -> NextCommand:
    """Return the command that ingests a trial's log again.

    If its candidate waits for a trial, it needs no name: it is recognised, or the log is refused.
    """
    what = ("--candidate", candidate) if candidate else ("--data",)
    return NextCommand("ingest", (_log_of(workspace, meta), *(what if not waits else ())))


def last_again(workspace: Folder, trials: Sequence[StoredTrial]) -> NextCommand | None:
    """Return the command that ingests the last foreign log among some trials again."""
    foreign = [one for one in trials if "source" in one.meta]
    if not foreign:
        return None
    return again(workspace, foreign[-1].meta, foreign[-1].trial.candidate)


def hashed(files: Sequence[Path]) -> str:
    """Return the SHA-256 of a log's file, or of the hashes if it has several files."""
    from grounded_trials.logs.log_files import digest_of  # slow: most commands read no log

    hashes = [hash_file(file) if file.is_file() else digest_of(file) for file in files]
    return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode())


def _log_of(workspace: Folder, meta: Mapping[str, str]) -> str:
    """Return the path of a trial's log if it is in or beside a folder in use, else LOG."""
    from grounded_trials.logs.log_files import log_files

    name, home = Path(meta["source"]).name, workspace.folder.resolve()
    for folder in (Path.cwd(), home, home.parent):
        with suppress(GroundedError, OSError, ValueError):  # its name may be none
            if hashed(log_files(folder / name)) == meta.get("source_sha256"):
                return os.path.relpath(folder / name)
    return "LOG"


def where_to_mend(
    workspace: Folder, used: Sequence[Trial], findings: Sequence[Finding]
) -> tuple[Finding, ...]:
    """Complete findings with the whole key of [log], or with advice if no trial was read by it."""
    from grounded_trials.workspace.intake.opening.columns_by_name import no_angles  # a slow import

    about = {one.stored.id: one.meta for one in workspace.trials()}
    findings = _at_limits(workspace, used, findings)
    feedback = workspace.config.task.feedback
    read = [meta for trial in used if "source_sha256" in (meta := about[trial.id])]
    if read:
        strange = no_angles(workspace.base_model, workspace.log_mapping)
        odd = [Finding(one.about[0], one, "mismatch") for one in strange]
        findings = (*odd, *findings)
        whole = (replace(one, keys=_whole(one, read[-1])) for one in findings)
        return tuple(
            replace(
                one,
                mend=_either(one) if feedback and one.keys and late_effects([one]) else one.mend,
            )
            for one in whole
        )
    how = {"delay": "late", "lag": "late", "sign": "sign", "degrees": "degrees"}
    return tuple(
        replace(one, keys={}, mend=_in_program(one.signal, how[one.kind], fed=feedback))
        if one.corrected and one.kind in how
        else one
        for one in findings
    )


def _in_program(name: str, how: str, *, fed: bool) -> said.Finding:
    """Return what the program that writes the trials should do."""
    return said.found("sensor.mend", name, how=how, fed=fed and how == "late")


def _either(one: Finding) -> said.Finding:
    """Return what to do about a late sensor, by whether the robot's program gets it as late."""
    other = one.said.facts.get("message") if one.said else None
    return said.found("sensor.mend", one.signal, log=one.log, of=other)


def one_message(workspace: Folder) -> tuple[str, ...]:
    """Return the states of a pose if one message holds them, else none.

    A message has one stamp, so its position and its heading are late together or not at all.
    """
    model, mapping = workspace.base_model, workspace.log_mapping
    pose = [*position(model), *filter(None, [heading(model)])]
    if mapping is None or len(pose) < 2 or not set(pose) <= set(mapping.states):
        return ()
    topics = {_topic(mapping.states[name].path) for name in pose}
    return tuple(pose) if len(topics) == 1 else ()


def _topic(path: str) -> str:
    return path.partition(".")[0]


def in_time_now(workspace: Folder, findings: Sequence[Finding]) -> dict[str, float]:
    """Return the delays found by a diagnosis that [log] now removes, by effect name [s].

    Args:
        workspace: the workspace with the current [log].
        findings: the findings of the diagnosis, with the whole key of [log].
    """
    late = [one for one in findings if one.kind == "delay" and "delay_s" in one.keys]
    if not late:
        return {}
    mapping = workspace.log_mapping
    states, found = mapping.states if mapping else {}, dict[str, float]()
    for one in late:
        whole = float(one.keys["delay_s"])
        now = states[one.signal].delay_s if one.signal in states else 0.0
        if now > whole - one.delay_s / 2:  # the trial was read with whole - delay_s
            found |= dict.fromkeys(late_effects([one]), now)
    return found


def twice_in_time(workspace: Folder) -> said.Finding | None:
    """Return that [log] now removes delays that adopted effects have in the model as well.

    A delay_s that trials were read with before the adoption is another part of the delay.
    """
    named = {str(one["name"]): float(one.get("d", 0.0)) for one in workspace.config.model.effects}
    late = {n.removeprefix(SENSOR_DELAY): d for n, d in named.items() if SENSOR_DELAY in n}
    mapping = workspace.log_mapping
    if mapping is None or not late:
        return None
    metas = [one.meta for one in workspace.whole_trials() if READ_BY in one.meta]
    before = {name: _keys(metas[-1], name) if metas else {} for name in late}
    twice = [
        name
        for name, d in late.items()
        if name in mapping.states
        and mapping.states[name].delay_s - before[name].get("delay_s", 0.0) > d / 2 > 0
    ]
    if not twice:
        return None
    keys = tuple(f"[log.state.{name}] delay_s" for name in twice)
    effects = tuple(SENSOR_DELAY + name for name in twice)
    return said.found("plan.delay_twice", *twice, keys=keys, effects=effects)


def _at_limits(
    workspace: Folder, used: Sequence[Trial], findings: Sequence[Finding]
) -> Sequence[Finding]:
    """Limit findings of saturated inputs to runs of candidates if [limits] were taken from a log.

    The log itself reaches these limits by construction, and so do other manual drives.
    """
    from grounded.accounts.signals import judge_limits

    if not seen_in(workspace.config):
        return findings
    inputs = [trial.inputs[: trial.known_steps] for trial in used if trial.candidate]
    left = judge_limits(workspace.task, np.concatenate(inputs)) if inputs else ()
    real = {one.signal: one for one in left if one.kind == "saturated"}
    return [
        real.get(one.signal, one) if one.kind == "saturated" else one
        for one in findings
        if one.kind != "saturated" or one.signal in real
    ]


def _whole(finding: Finding, meta: Mapping[str, str]) -> Mapping[str, Any]:
    """Return the whole key of [log] for a finding, combined with the keys used for a trial."""
    now = _keys(meta, finding.signal)
    if not finding.keys or not now:
        return finding.keys
    keys = dict(finding.keys)
    if "scale" in keys:
        by = float(keys["scale"])
        keys["scale"] = by * now["scale"]
        offset = by * now["offset"] + float(keys.get("offset", 0.0))
        keys |= {"offset": offset} if offset else {}
    if "delay_s" in keys:
        keys["delay_s"] = float(f"{keys['delay_s'] + now['delay_s']:.3g}")
    return keys


def _keys(meta: Mapping[str, str], signal: str) -> dict[str, float]:
    """Return the keys by which a signal was read, {} if unchanged or not known."""
    found = _keys_by(meta).get(signal, {})
    keys = {key: found[key] for key in PLAIN if key in found}
    return keys if keys != PLAIN and all(map(math.isfinite, keys.values())) else {}
