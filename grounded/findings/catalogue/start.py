"""Findings on how a workspace begins: what a log's numbers are, and why."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    # why a number of the log is a state or input
    "unit": Entry("note", "its unit is {unit}"),
    "unit_other": Entry("note", "its unit is {unit} in the log, {model} in the model"),
    "joint": Entry("note", "{about} names its joint '{joint}'"),
    "joint_order": Entry(
        "note",
        "in order from the base, {index} of {about} is '{joint}'",
        "check it by the joints of the controller",
    ),
    "effort": Entry("note", "only it follows the measured effort of this joint"),
    "follows": Entry(
        "note",
        "it follows the derivative of {of}{sign:1=,-1= with the OPPOSITE SIGN}, correlation "
        "{correlation:.3f}",
    ),
    "unfollowed": Entry(
        "note", "it does not follow the derivative of {of}, correlation {correlation:.2f}"
    ),
    "times": Entry("note", "it is {slope:.3g} times the derivative of {of}"),
    "in_degrees": Entry("note", "its size shows DEGREES"),
    "same_unit": Entry("note", "{about} are taken to have one unit: they are of one size"),
    "exchanged": Entry(
        "note",
        "{about} look exchanged: the first follows the derivative of the second, correlation "
        "{correlation:.3f}, with the right sign and size",
        "if so, exchange these paths",
    ),
    "speed": Entry(
        "note",
        "it follows the speed of {of}, correlation {correlation:.3f}, {slope:.3g} times as large",
    ),
    "pose": Entry(
        "note",
        "measured independently of the wheels, from whose speed the pose of {about} is most "
        "likely integrated",
    ),
    "still": Entry("note", "{about} never changes in this log"),
    "alone": Entry(
        "note",
        "no name matches; by {command:0=unit,1=being a command} only {numbers} fit{numbers:s/}",
    ),
    "left": Entry("note", "no name matches; {numbers} {numbers:is/are} left, in the log's order"),
    "steps": Entry("note", "with it the model's steps fit {share:%} better than the next best"),
    "steps_tie": Entry("note", "the model's steps don't clearly favour one"),
    "no_messages": Entry("note", "{about} {about:has/have} no messages", "record the commands"),
    "given": Entry("note", "a guess: only its name is in the log"),
    "asked": Entry("note", "as you specified"),
    "encoder": Entry(
        "note", "of '{joint}', times the radius r", "enter yours here and in model.py"
    ),
    # what the file of a model says
    "unmoved": Entry(
        "note",
        "{about} {about:is/are} no {about:state/states}, as no input moves {about:it/them}",
        "delete `without` in model.py to have {about:it/them}",
    ),
    "outside": Entry(
        "note",
        "not all ranges of the joints include 0: {about} {about:starts/start} in the middle of "
        "{about:its range/their ranges}",
        "set [task] start",
    ),
    "degrees": Entry(
        "note",
        "{about} is in rad by the model, but goes from {low} to {high}",
        "[[target? its course shows degrees: multiply it by {scale:.8g}]][[!target? if in degrees,"
        " set scale = {scale:.8g} in [log], of its rate too; [limits] are in rad]]",
    ),
    "no_start": Entry(
        "refuse",
        "{about} can't begin a workspace: {why:own=grounded wrote it,text=it holds no numbers,"
        "still=nothing changes in it}[[ ({names})]]",
        "give a log in which the robot moves, with its states and commands as numbers",
    ),
    "damaged": Entry("refuse", "{why}"),
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
        "with another,rest=the line ends at rest,swing=it would be held during the swing}[[, "
        "{end}]]",
        "omit it[[rate?, or ask for 0 (--to {about}=0)]]"
        "[[; --hold 1 lets the path end at rest and stay there{hold:1=}]]",
    ),
    "no_way": Entry(
        "refuse",
        "the line ends where it starts, at {to}",
        "change --to[[: it ends at rest, so say where, such as --to {goes}=1.0]]",
    ),
}
