"""Findings on how a workspace begins: what a log's numbers are, and why."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    # why a number of the log is a state or input
    "unit": Entry(
        "note",
        "{about:its/their} unit is {unit}[[ in the log, {model} in the model]][[size? , by size]]",
    ),
    "joint": Entry(
        "note",
        "[[{index} of ]]{about} is its joint[[ '{joint}']][[index? , in order from the base: check "
        "it]]",
    ),
    "follows": Entry(
        "note",
        "it [[no? does not follow]][[!no? follows]] the [[speed? speed]][[!speed? derivative]] of "
        "{of}[[opposite?  with the OPPOSITE SIGN]][[, correlation {correlation:.3f}]]"
        "[[, {slope:.3g} times as large]]",
    ),
    "still": Entry(
        "note",
        "{about} never {about:changes/change} in this log",
        "[[empty? there are no messages: record the commands]]",
    ),
    "left": Entry(
        "note",
        "no name matches; {numbers} {numbers:is/are} left[[only? , by unit]][[!only? , in the "
        "log's order]]",
    ),
    "steps": Entry(
        "note",
        "with it the model's steps fit {share:%} better than the next best",
    ),
    "given": Entry("note", "as you specified"),
    "unused": Entry(
        "note", "{about} {about:is/are} not used of the log: [log] can name {about:it/them}"
    ),
    "angles": Entry(
        "note",
        "{about} is a heading, of which a whole turn counts as an error",
        "declare angles = {declared} in model.py",
    ),
    "interval": Entry(
        "note",
        "[[the log's commands change every {every:.3g} s; dt is {dt:.3g} s]][[, its rows come "
        "every {rows:.3g} s]][[read as seconds, its rows are {apart:.3g} s apart]]",
        "[[every? [task] dt (--dt) sets another]][[apart? if the times are in ms or us, end that "
        "column's name with _ms or _us and create the workspace again in another folder]]",
    ),
    # what the file of a model says
    "unmoved": Entry(
        "note",
        "{about} {about:is/are} no {about:state/states}, as no input moves {about:it/them}",
        "delete `without` in model.py to have {about:it/them}",
    ),
    "outside": Entry(
        "note",
        "{about} {about:starts/start} in the middle of {about:its range/their ranges}, which "
        "{about:does/do} not include 0",
        "set [task] start",
    ),
    "degrees": Entry(
        "note",
        "{about} is in rad by the model: {turns:.2g} turns",
        "[[if you meant degrees, use `--to {about}={to}`]][[!to? if in degrees, multiply it by "
        "{scale:.8g}]]",
    ),
    "no_start": Entry(
        "refuse",
        "{about} can't begin a workspace: {why:own=grounded wrote it,text=it holds no numbers,"
        "still=nothing changes in it}[[ ({names})]]",
        "give a log in which the robot moves, with its states and commands as numbers",
    ),
    # the drawing of a target
    "no_position": Entry(
        "refuse",
        "model '{about}' has no role 'position' of two states, which a {shape} needs",
        "add {roles} to model.py; line and step with --to STATE=VALUE need no role",
    ),
    "sideways": Entry(
        "refuse",
        "the role 'speed' of model '{about}' is {speed}, which moves it across its heading",
        'write "speed": "{ahead}" in model.py',
    ),
    "follows_path": Entry(
        "refuse",
        "--to {about}={asked} can't be chosen: {why:path=the shape sets it,ends=the path ends "
        "with another,rest=the line ends at rest}",
        "omit it[[rate?, or ask for 0 (--to {about}=0)]]"
        "[[; --hold 1 lets the path end at rest and stay there{hold:1=}]]",
    ),
}
