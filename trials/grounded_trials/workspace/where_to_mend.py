"""Say where to correct an instrument finding: in [log], or in the program that writes the trials.

A finding refers to signals as they were read, so its correction is combined with the keys of [log]
at that time: scales multiply, delays add. The metadata of each trial records these keys.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from grounded import findings as said
from grounded.accounts.finding import SENSOR_DELAY, Finding, late_effects
from grounded.places import heading, position
from grounded_trials.workspace.identity import READ_BY
from grounded_trials.workspace.last_diagnosis import PLAIN
from grounded_trials.workspace.user_files.task_file import seen_in

if TYPE_CHECKING:
    from grounded.trial import Trial
    from grounded_trials.workspace.folder import Folder


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
                mend=_either(one)
                if feedback and one.keys and late_effects([one])
                else one.mend or _late_message(workspace, one, read[-1]),
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


def _late_message(workspace: Folder, one: Finding, meta: Mapping[str, str]) -> said.Finding | None:
    """Return what to set if a speed is early: no sensor is, so the message of the position is late.

    None for other findings, if both come in one message, or if its states were read differently.
    """
    where, mapping = position(workspace.base_model), workspace.log_mapping
    states = mapping.states if mapping else {}
    if one.kind != "delay" or one.delay_s >= 0 or not {*where, one.signal} <= {*states}:
        return None
    topic = _topic(states[where[0]].path)
    names = [name for name, spec in states.items() if _topic(spec.path) == topic]
    whole = {_keys(meta, name).get("delay_s", 0.0) - one.delay_s for name in names}
    if one.signal in names or not {*where} <= {*names} or len(whole) > 1:
        return None
    fed = workspace.config.task.feedback
    return said.found("sensor.mend", *names, delay=whole.pop(), fed=fed)


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
    from grounded.accounts.inputs import judge_limits

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
    """Return the keys by which a signal was read, {} if unchanged or invalid (untrusted file)."""
    try:
        found = json.loads(meta.get(READ_BY, "{}")).get(signal, {})
        keys = PLAIN | {key: float(found[key]) for key in PLAIN if key in found}
    except (ValueError, TypeError, AttributeError, RecursionError):
        return {}
    return keys if all(map(math.isfinite, keys.values())) and keys != PLAIN else {}
