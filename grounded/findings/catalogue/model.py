"""Findings on the model: what the data can't tell of it, its parameters, its adopted effects."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    # what the trials can't show
    "one_trial": Entry(
        "warn",
        "one trial alone confirms nothing",
        "run a second one, or one of {steps} steps or more",
    ),
    "few_steps": Entry(
        "warn",
        "{steps:step} in all are too few to tell an effect from noise",
        "record {needed} or more",
    ),
    "still": Entry(
        "warn", "{about} never changed, so effects on {about:it/them} can't be identified"
    ),
    "unmeasured": Entry("note", "{about} {about:was/were} never measured"),
    "stretches": Entry(
        "note", "{used} of {all} stretches of the trials were used, those with most motion"
    ),
    "share": Entry(
        "note",
        "of {total:,} steps {used:,} were used[[, in {kept} of {trials} trials]]"
        "[[first?, the first of each]]",
        "name trials with --trials to use others",
    ),
    "copy": Entry("warn", "{about} equals {first}: a copy, or no noise at all; it counts once"),
    # its parameters
    "off": Entry("note", "[[{values}]][[!values?{names} {names:is/are} off]]"),
    "given": Entry(
        "note",
        "{about} {about:is/are} known only if {rests} {rests:is/are} right as declared",
        "measure one of them to know each",
    ),
    "jointly": Entry("note", "{about} {about:is/are} known only together with the others"),
    "not_told": Entry(
        "note", "the trials do not tell {about}, which {about:stays/stay} as {about:it/they} was"
    ),
    "at_bound": Entry(
        "warn",
        "{about} stopped at {about:its/their} bound or std, and the trials ask for more",
        "widen it in the model file, or diagnose what the model lacks",
    ),
    "unneeded": Entry(
        "note",
        "the adopted {effect} may be none ({value})",
        "remove it from [model] effects and diagnose again to see whether it is missed",
    ),
    "joint_friction": Entry(
        "note",
        "{about} may be one cause: friction in the joint of {joint}, which acts on both through "
        "the inertia",
        "write this torque into model.py with an uncertain parameter",
    ),
    "gear": Entry(
        "note",
        "a gear between {rate} and {state} that differs from the model would look the same as a "
        "sensor's scale",
        "measure how far {state} really moves",
    ),
    "level": Entry(
        "note",
        "a mount out of level looks the same in any log as a wrong zero of {about}",
        "check the level before you correct the sensor",
    ),
    # a fit
    "fitted": Entry(
        "note",
        "{settled:yes=converged,no=still rising}, from {samples:sample}[[ of {trials}]]",
    ),
    "fit_failed": Entry("warn", "nothing was fitted: {why}"),
    "fit_no_better": Entry(
        "note", "the values before are as likely, or predict held-out trials as well"
    ),
    "fit_worse": Entry(
        "refuse",
        "the fitted values predict held-out trials worse ({state} {ahead:.3g} s ahead: "
        "{now:size} instead of {before:size}); they make up for something that the model lacks",
    ),
    "stands_in": Entry(
        "note",
        "fitted parameters can also make up for effects that the equations lack",
        "`grounded diagnose` separates the two",
    ),
    "delay_kept": Entry(
        "note",
        "{about} kept {about:its/their} d, which the intervals take as exact",
        "`grounded fit --latency` fits one delay of all inputs instead",
    ),
    "times": Entry(
        "note",
        "times are known to[[ {rows:.3g} s between rows of the log]][[ {early:.2g} s by the "
        "interpolation of states]] at best, which is in their intervals",
    ),
    # an adoption
    "adopted": Entry("note", "adopted: {about}"),
    "unclaimed": Entry(
        "note",
        "{effect} was not claimed: its values were fitted in place of what was, and the "
        "model's parameters are unchanged",
    ),
    "beside": Entry(
        "warn",
        "{about} {about:was/were} fitted in place of what is adopted now, not together with it",
        "remove one of them from [model] effects, or diagnose again",
    ),
    "along": Entry(
        "note",
        "{about} came along: the plan allows for late sensors, as the robot's program gets them so",
        "if only the log is late, `grounded adopt --undo`, set delay_s in [log] and adopt again",
    ),
    "biased": Entry(
        "note",
        "the robot is steered by its sensor of {state}, which reads {bias} too {way}",
        "add that to {state} where [task] start and the target are true values, not its readings; "
        "or correct the log (offset {offset:+.3g} in [log.state.{state}]) and remove the effect",
    ),
    "scaled": Entry(
        "note",
        "targets and distances of {state} are in readings of its sensor, {by:.3g} % "
        "{way:low=below,high=above} the true value",
        "for true values set scale in [log.state.{state}] and in the robot's program, and remove "
        "the effect",
    ),
    "late": Entry(
        "note",
        "targets and distances of {about} are in readings that are {age:.3g} s old: the robot is "
        "ahead of them by that",
    ),
    "kept": Entry(
        "note",
        "{name} stays at {kept}, which these trials do not determine; the effects were fitted with "
        "it at {value}",
        "`grounded diagnose` compares the changed model with the trials",
    ),
    "logged_target": Entry(
        "note",
        "target.csv is still the logged drive, {about}",
        "draw the manoeuvre first (`grounded target --help`), or propose to repeat that drive",
    ),
    # taken home
    "not_held": Entry(
        "warn",
        "{about} has no place in this form: {equation}, with {values}",
        "add it to the program that steps the model",
    ),
    "no_place": Entry(
        "warn",
        "{about} = {value} has no place in the file",
        "set it where the model is loaded",
    ),
    "reads": Entry("note", "the file reads {about}", "put {about:it/them} beside it"),
    "no_file": Entry(
        "refuse",
        "the model is not in a file of its own that can be written with other values",
        "put it into an MJCF, URDF or Python file that model.py names",
    ),
    "other_form": Entry(
        "refuse",
        "{file} can't be written: the model comes from {source}, which stays as it is",
        "name another file with the same ending",
    ),
    # what can't be adopted, or undone
    "not_adoptable": Entry(
        "refuse",
        "{about} can't be adopted: {why:adopted=it stands in [model] effects already,alike=it has "
        "no values of its own: it only looks like,rival=it was fitted instead of what is claimed, "
        "not with it,worse=it does not predict trials better that it was not fitted to,together="
        "it was fitted together with,unvalued=the diagnosis lacks its value}[[ {effect}]][[, of "
        "whose signal it reproduces {share:%}]]",
        "{why:rival=adopt the claimed, or one alone,worse=run more trials and diagnose again,"
        "together=adopt them together}",
    ),
    "delayed_twice": Entry(
        "refuse",
        "[log.state.{state}] delay_s = {delay} removes the delay {about} from every log already",
        "remove delay_s, so that plans allow for the delay; or keep it, and let the robot's "
        "program predict the state ahead by as much",
    ),
    "no_adoption": Entry(
        "refuse",
        "no adoption is left to undo; [model] effects in {about}: {effects}",
        "remove there what was written by hand",
    ),
    "edited": Entry(
        "refuse",
        "[model] in {about} was changed after {adopted} was adopted, which undoing would lose",
        "edit it by hand; before the adoption it had {had}",
    ),
    # its file
    "fails": Entry("refuse", "{about}[[ line {line}]]: {why}"),
    "undefined": Entry(
        "refuse",
        "{about} does not define `model = Model(...)`",
        "[[rename '{other}' to 'model']][[!other? see the README for an example]]",
    ),
    "assigned": Entry(
        "refuse", "{about}: a {what} can't be assigned to", "use a local variable for '{name}'"
    ),
    "name_only": Entry(
        "refuse",
        "{about}: '{name}' names one of the {what}s and is not its value",
        "write s.{name} for a function f(s, ...), or unpack s.values()",
    ),
    "returns": Entry(
        "refuse",
        "{about}: the model must return a dict of all states[[ ({states}), not a {type}]][[; "
        "missing: {missing}]]",
    ),
    "untraced": Entry(
        "refuse",
        "{why}",
        "[[long? write it with fewer steps, or give the model as step=, which is run as it is]]"
        "[[!long? use np.where: that holds for these parameters only]]",
    ),
    # models that are compared
    "yaml": Entry(
        "refuse",
        "{about} can't be read: {why}",
        "write `name: value` a line, with params: and effects: as tables",
    ),
    "no_rival": Entry(
        "refuse",
        "there is no {about}",
        "name a workspace, a model.py, an MJCF or URDF file, or a YAML file with values",
    ),
    "not_loaded": Entry("refuse", "MuJoCo can't load {about}: {why}"),
    "other_names": Entry(
        "refuse",
        "{about} has other states or inputs than this workspace's model",
        "compare models of one robot, with the same names",
    ),
    # an actuator on its own
    "which_actuator": Entry("refuse", "one input is to be named: {named}"),
    "nothing_found": Entry(
        "refuse", "nothing is known of {about} beyond the model", "adopt or fit something first"
    ),
    "begun": Entry("note", "the model begins with {about}, as sure as that file is of each value"),
}
