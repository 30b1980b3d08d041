"""Refuse as commands what the robot measured: joint positions and speeds, or the path of a state.

A model whose input is a state's own number explains that state by itself, and nothing else.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from grounded.result import listed
from grounded_trials.logs.inspect_guess import COMMAND_TOPIC, Guess
from grounded_trials.logs.inspect_log import LogReport, TopicReport

JOINT = re.compile(r"\.(position|velocity)\[\d+\]$")  # numbers of a JointState
FEW = 3  # command topics named in a reason


def is_measured(topic: str, kind: str, path: str) -> bool:
    """Check whether a number is a joint's position or speed, on a topic that is not of commands.

    Args:
        topic: name of the topic.
        kind: the topic's message type.
        path: of the number.
    """
    if not kind.endswith("/JointState") or COMMAND_TOPIC.search(topic.lower()):
        return False
    return JOINT.search(path) is not None


def only_commands(
    states: Sequence[Guess], inputs: Sequence[Guess], log: LogReport
) -> tuple[Guess, ...]:
    """Return the inputs without numbers that are measured, each with the reason.

    Args:
        states: guesses for the states.
        inputs: guesses for the inputs.
        log: an inspected log.
    """
    of_state = {guess.path: guess.name for guess in states if guess.path}
    fields = [(t, f.path) for t in log.topics for f in t.fields]
    refused = {path: "measured" for t, path in fields if is_measured(t.topic, t.type, path)}
    refused |= {path: f"the state {name}" for path, name in of_state.items()}
    found = []
    for guess in inputs:
        others = tuple(path for path in guess.others if path not in refused)
        if guess.path in refused:
            why = f"{guess.path} is {refused[guess.path]}, not a command"
            guess = Guess(guess.name, "", "", False, others, None, (why,))
        missing = () if guess.path else _not_recorded(log.topics)
        reasons = tuple(dict.fromkeys((*guess.reasons, *missing)))
        found.append(replace(guess, others=others, reasons=reasons))
    return tuple(found)


def _not_recorded(topics: Sequence[TopicReport]) -> tuple[str, ...]:
    """Return a reason that names the command topics without messages."""
    empty = [t.topic for t in topics if not t.messages and COMMAND_TOPIC.search(t.topic.lower())]
    have = "has" if len(empty) == 1 else "have"
    return (f"{listed(empty[:FEW])} {have} no messages: record the commands",) if empty else ()
