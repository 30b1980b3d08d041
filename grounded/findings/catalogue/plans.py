"""Findings on candidates: what they will do, whether to trust them, and where the search stands."""

from __future__ import annotations

from grounded.findings.catalogue.entry import Entry, note, refuse, warn

MODEL = "a diagnosis may show what the model lacks"

# what a candidate will do, and whether to trust it
PLAN: dict[str, Entry] = {
    # there is no candidate
    "no_weight": refuse(
        "no weight of the reward is above 0, so there is nothing to improve",
        "set a weight for a state that the target gives, such as {state}",
    ),
    "none": refuse(
        "there is no plan to run[[: {why}]][[: the {what} of {about} is not a finite number at t "
        "= {at}]]",
        "correct the model there, or choose a start and a target at which it is valid",
    ),
    "outside": refuse(
        "[[{candidate}]][[!candidate? it]][[ (alpha = {alpha:.6g})]] takes {state} to {value}[[ "
        "at t = {at}]], outside [{table}] {state} = [{low}, {high}]",
    ),
    "gain": refuse(
        "the gain of {input} on {state} reaches {gain} in {candidate}, at t = {at}, more than "
        "{most:.6g}",
        "check the unit of {state} and what it drives in the model, weigh it less in [reward], or "
        "raise [reward] input_change of {input} (now {change:.6g})",
    ),
    # what it is, what it promises, how far to trust it
    "made": note(
        "[[!base? the model's own policy]][[, made gentler after {crashes} crashes]][[own? the "
        "changed model's own plan, instead of a step from {base}]][[{base} with its gains reduced "
        "to {share:%}: its feedback made the inputs swing]][[iteration {iteration}: {step} from "
        "{base}]][[corrected? , with derivatives corrected by the trials]][[gentle? , its gains "
        "as low as ran without oscillating]], {seconds}",
    ),
    "predicted": note(
        "utility {utility}[[, about {log} in its log]][[, {noise} of it by sensor noise]]"
    ),
    "so_far": note(
        "{utility} by {best}[[, {noise} of it by sensor noise]]",
    ),
    "tested": note(
        "the last predictions missed the utility by {missed}[[; {failed:run} failed]][[; this one "
        "promises a gain of {gain}]][[less? , less than such an error]]",
    ),
    "untested": note(
        "unknown: no run has tested the model[[changed?  since it was changed]][[; it can be "
        "checked against {logs:log} of data (`grounded diagnose`)]]",
        "[[exact? the prediction starts exactly at [task] start]]",
    ),
    "model": note("the model is {what}"),
    "no_target": refuse(
        "there is no manoeuvre to learn: [task] names no target",
        "draw one with `grounded target`; `fit` and `diagnose` need none",
    ),
    "not_optimal": note(
        "the plan is not optimal in the model: {why}; it can be run all the same: the steps from "
        "its run go on improving it",
    ),
    "small": note(
        "{candidate} promises {gain:.2g} over {best}, less than its trial can show: a gain below "
        "{luck:.2g} may be luck",
        "[[it gains at most {share:%} of what {best} costs: run it if that is worth a run, else "
        "stop with {best} (`export best`)]]",
    ),
    # the first plan of a task
    "no_limits": note("[limits] has none for {about}: plans may send values of any size"),
    "without_effect": note(
        "{about} {about:changes/change} no state in the model",
        "complete the equations and values in {file}",
    ),
    "limits_of_log": note(
        "[limits] are only the range used in {log}",
        "enter the robot's real limits, then delete seen_in there",
    ),
    # it is not handed over, or not without a warning
    "refused": refuse(
        "{about} is [[!anyway? not ]]handed over[[anyway?  anyway]]: {why}",
        "[[!anyway? propose another, or use --anyway to hand it over regardless]]",
    ),
    "unmapped": refuse(
        "[log] maps no {about}, though {file} has {about:that as an input/those as inputs}: which "
        "command of the robot that is, and in which unit, was never compared with a log",
        "map it in [log]; if another command drives the robot, put that into {file} under its own "
        "name and unit",
    ),
    "delay_twice": refuse(
        "{keys} {keys:removes/remove} from every log the delay that {effects} {effects:has/have} "
        "in the model as well",
        "remove delay_s there again, so that plans allow for the delay that the robot's program "
        "sees, or go without {effects} (`adopt --undo` undoes an adoption)",
    ),
    "other_task": refuse(
        "{about} was made for another task[[ ({what})]][[never? , and was not run there]]"
    ),
    "outdated": note(
        "the model was changed since {candidate} was made: its prediction is outdated"
    ),
    "no_better": note(
        "the model was changed since {about} was planned, and it promises no better plan"
    ),
    "void": note(
        "{candidate} was not run and is void[[: {why}]][[: {trials}, which it was made from, "
        "{trials:is/are} {gone}]][[; run {instead} instead]]",
        "[[!other? if the robot has run it meanwhile, ingest that log with --candidate "
        "{candidate}: it counts]]",
    ),
    # what the robot will do
    "time_step": warn(
        "{about} is missed by {share:%} of its change in a step: the integrator's steps of {step} "
        "are too long for the model",
        "[[set substeps={substeps} in Model(...)]][[!substeps? make the model less stiff]] in "
        "{file}, and plan or diagnose again",
    ),
    "coasts_out": warn(
        "after the run its runner holds {held}, and the model predicts that the robot leaves "
        "[safety] {state} = [{low}, {high}] {at} later and reaches {most}",
        "be ready to stop the robot, switch to a holding controller after it, or let the target "
        "come to rest inside",
    ),
    # a drive that excites the model's parameters
    "no_drive": refuse(
        "[[!state? by the model, no drive stays from [task] start where the robot may go, which "
        "[safety] says, or else the logs]][[state? [safety] bounds no state, and no log shows "
        "where the robot may go]]",
        "[[!state? start where there is room, make it shorter (--seconds), or widen "
        "[safety]]][[enter where it may go, such as [safety] {state} = [-1.0, 1.0]]]",
    ),
    "drive_weak": note(
        "the drive leaves {about} weak",
        "make it longer (--seconds), or hold one of those that only act together constant",
    ),
}

# where the search stands, and how it ended
SEARCH: dict[str, Entry] = {
    # it goes on
    "first": note(
        "[[!crashed? the first candidate is the model's own policy]][[{crashed} crashed: the next "
        "first policy is gentler]]",
    ),
    "step": note("improve on {best} with {step}[[, since {crashed} crashed]]"),
    # it waits
    "waiting": note("{candidate} is waiting for {missing:trial}"),
    "in_doubt": note(
        "{loser} lost to {best}[[known? by no more than noise may explain]]: {candidate} is "
        "waiting for another trial[[. {loser} promises {share:%} of what {best} costs: if that is "
        "not worth a run, stop with {best} (`export best`)]]",
    ),
    "discard_first": note("discard {trial}, a run of {candidate}, or go on with it: `propose`"),
    "to_robot": note(
        "[[ended? the search has ended with {about}]][[!ended? copy both files to the robot, run "
        "{about} and record a log]]",
    ),
    # it has ended with a result
    "no_step": note(
        "no step improved on {best}[[ down to alpha = {alpha:.6g}]][[ in the last {last} "
        "candidates]][[ ({lost} lost)]][[; the next promises {gain}, with a likely error of "
        "{error}]][[; the model promises less than {least:%} from smaller steps]]: {best} is the "
        "result",
    ),
    "little": note(
        "the last {last} candidates gained {gain:.3g} in total, less than [[{least:%} each "
        "([search] tolerance)]][[its standard error of {error:.2g}]]: {best} is the result",
    ),
    # it has ended without one
    "used_up": note(
        "{used} of {most} trials are used up[[; a candidate needs {needs}]] ([search] max_trials)"
    ),
    "crashed": note(
        "the first policy crashed {crashes} times, although each was gentler: the model is too "
        "inaccurate to start from",
        MODEL,
    ),
    "diverges": note(
        "the model grounded on {best} [[!least? diverges for every step]][[loses with every step, "
        "by at least {least:.4g}]]: it is too inaccurate there to improve with",
    ),
    # what helps more than the next trial
    "lost_in_row": note("{lost} steps in a row did not improve", MODEL),
    "crashes": note("{crashes} policies crashed in a row", MODEL),
    "far_off": note(
        "{candidate} [[gave {real:.4g}]][[!real? failed]], but {promised:.4g} was predicted", MODEL
    ),
    "within_model": note(
        "the model alone reaches {promised:.4g}, {by:.3g} more than the {real:.4g} of {best}", MODEL
    ),
    "diagnose": note(MODEL),
    # what status tells beside it
    "uncounted": note(
        "{about} {about:counts/count} only as data, for fit and diagnose: {about:it/they} ran "
        "another task's candidate or a probe",
    ),
    "left_out": note(
        "{about} {about:has/have} another sampling interval than [task] dt, or other states or "
        "inputs than the model: fit, diagnose and the search leave {about:it/them} out",
    ),
    "outdated": note(
        "the last diagnosis is outdated[[; it had "
        "{used} of {usable} trials]][[; adopted since: {adopted}]][[, but not "
        "{missing}]][[changed? ; the model was changed]]",
    ),
    "stops": note(
        "learn stops here, since the next plan would be based on this log",
        "fix it first, or run `learn` again if the warning is wrong",
    ),
    # names
    "aside": refuse("{about}[[, a run of {candidate},]] is set aside[[ ({why})]]"),
    "unknown": refuse(
        "{about} is no {kind} of this [[unusable? task, by its length, states, inputs or "
        "dt]][[!unusable? workspace]][[; did you mean '{meant}'?]][[; there are: {known}]]",
    ),
    "no_trial": refuse(
        "there is no trial to learn from[[: {about} {about:is/are} set aside]]",
        "ingest runs of candidates, or other logs with --data",
    ),
    "none_waits": refuse(
        "[[{log} does not say which candidate it ran, and ]]no candidate is waiting for a trial",
        "[[log? name it with --candidate ID, or use --data for a log that ran none]][[!log? make "
        "the next one, or name the candidate that is run]]",
    ),
    "undiagnosed": refuse("there is no diagnosis[[ of {about}]] yet", "diagnose first"),
    # how sure a gain is
    "gain": note(
        "the last gain in utility, of {after} over {before}, is {gain}[[, an improvement with "
        "probability {probability:.2f}]][[exact? ; repeated trials agree exactly]][[single? ; "
        "runs of similar utility were not repeated, so their noise is unknown]]",
    ),
    "better": note(
        "{share:%} {better:1=better,0=worse} than the model's own policy[[, +- {error:%}]]",
    ),
    "lead": note("the scatter of runs may explain its lead on the model's own policy"),
}
