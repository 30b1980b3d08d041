"""Findings on what a candidate will do, and whether to trust it."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

STOP = "be ready to stop the robot"

ENTRIES: dict[str, Entry] = {
    # there is no candidate
    "no_weight": Entry(
        "refuse",
        "no weight of the reward is above 0, so there is nothing to improve",
        "set a weight for a state that the target gives, such as {state}",
    ),
    "none": Entry(
        "refuse",
        "there is no plan to run[[: {why}]][[: the {what} of {about} is not a finite number at t = "
        "{at}]]",
        "correct the model there, or choose a start and a target at which it is valid",
    ),
    "outside": Entry(
        "refuse",
        "[[{candidate}]][[!candidate? it]][[ (alpha = {alpha:.6g})]] takes {state} to {value}[[ at "
        "t = {at}]], outside "
        "[{table}] {state} = [{low}, {high}]",
        "[[+- is the distance of trial {trial} from what it should repeat: if that run was "
        "disturbed, remove it with `discard {trial}`]]",
    ),
    "gain": Entry(
        "refuse",
        "the gain of {input} on {state} reaches {gain} in {candidate}, at t = {at}, more than "
        "{most:.6g}[[; the plan moves {state} by {moved}]]",
        "[[weigh {state} less in [reward] (now {state_weight:.3g}), or ]][[!state_weight? check "
        "the unit of {state} and what it drives in the model, or ]]raise [reward] input_change of "
        "{input} (now {change:.6g})",
    ),
    # what it is, what it promises, how far to trust it
    "made": Entry(
        "note",
        "[[!base? the model's own policy]][[, made gentler after {crashes} crashes]][[own? the "
        "changed model's own plan, instead of a step from {base}]][[{base} with its gains reduced "
        "to {share:%}: its feedback made the inputs swing]][[iteration {iteration}: {step} from "
        "{base}]][[corrected? , with derivatives corrected by the trials]][[gentle? , its gains as "
        "low as ran without oscillating]], {seconds}",
    ),
    "predicted": Entry(
        "note",
        "utility {utility}[[, about {log} in its log]][[, {noise} of it by sensor noise]]",
    ),
    "so_far": Entry(
        "note",
        "{utility} by {best}[[, {noise} of it by sensor noise]][[; for {best} itself the model "
        "predicts {model}, of which {candidate} is to gain {gain}]]",
    ),
    "tested": Entry(
        "note",
        "[[promised? the last prediction was {promised}]][[real? , the run gave {real}]]"
        "[[!promised? the last predictions missed the utility by {missed}]][[; {failed:run} "
        "failed]][[; this one promises a gain of {gain}]][[less? , less than such an error]]"
        "[[noise? , which may only be the noise of the run that it replays]]",
    ),
    "untested": Entry(
        "note",
        "unknown: no run has tested the model[[changed?  since it was changed]][[; it can be "
        "checked against {logs:log} of data (`grounded diagnose`)]]",
        "[[exact? the prediction starts exactly at [task] start]]",
    ),
    "model": Entry("note", "the model is {what}"),
    "lacks": Entry(
        "note",
        "the last diagnosis found that {cause}[[, and {more:cause} more]]",
        "`{command}` first",
    ),
    "no_target": Entry(
        "refuse",
        "there is no manoeuvre to learn: [task] names no target",
        "draw one with `grounded target`; `fit` and `diagnose` need none",
    ),
    "waits_void": Entry(
        "refuse",
        "{standing}, but {why}",
        "undo what was changed, or run {candidate} regardless with --anyway",
    ),
    "not_optimal": Entry(
        "note",
        "the plan is not optimal in the model: {why}; it can be run all the same: the steps from "
        "its run go on improving it",
    ),
    "small": Entry(
        "note",
        "{candidate} promises {gain:.2g} over {best}, less than [[its trial can show: a gain below "
        "{luck:.2g} may be luck]][[the model's likely error there, "
        "judging by earlier trials: {error:.3g}]]",
        "[[it gains at most {share:%} of what {best} costs: run it if that is worth a run, else "
        "stop with {best} (`export best`)]]",
    ),
    # the first plan of a task
    "no_limits": Entry("note", "[limits] has none for {about}: plans may send values of any size"),
    "without_effect": Entry(
        "note",
        "{about} {about:changes/change} no state in the model",
        "complete the equations and values in {file}",
    ),
    "limits_of_log": Entry(
        "note",
        "[limits] are only the range used in {log}",
        "enter the robot's real limits, then delete seen_in there",
    ),
    "falls_short": Entry(
        "note",
        "[[{about} {about:is/are} at a limit for {share:%} of the plan, and still ]]the plan "
        "misses "
        "its target: {what} is off by {off:size}[[!share?  at the end]]",
        "draw a larger or slower target, weigh inputs and their changes less, check model.py, or "
        "widen [limits] if the robot can take more",
    ),
    "unguarded": Entry(
        "note",
        "{about} {about:leaves/leave} [safety], and [[unweighed? [reward] has no weight for "
        "{about:its/their} target]][[!unweighed? nothing in [reward] keeps {about:it/them} "
        "inside]]",
        "[[unweighed? add one in [reward] state]][[!unweighed? draw the target with a column for "
        "{about:it/each of them} (`target`); widen [safety] only if the robot may go there]]",
    ),
    "not_at_rest": Entry(
        "warn",
        "the plan assumes {held} before the start and after the end, under which {state} changes "
        "at once, by {rate}",
        "if nothing but its inputs holds the robot there, put what does into [task] of "
        "grounded.toml: start = {start}; else just propose again",
    ),
    # it is not handed over, or not without a warning
    "refused": Entry(
        "refuse",
        "{about} is [[!anyway? not ]]handed over[[anyway?  anyway]]: {why}",
        "[[!anyway? propose another, or use --anyway to hand it over regardless]]",
    ),
    "unmapped": Entry(
        "refuse",
        "[log] maps no {about}, though {file} has {about:that as an input/those as inputs}: which "
        "command of the robot that is, and in which unit, was never compared with a log",
        "map it in [log]; if another command drives the robot, put that into {file} under its own "
        "name and unit",
    ),
    "delay_twice": Entry(
        "refuse",
        "{keys} {keys:removes/remove} from every log the delay that the adopted {effects} "
        "{effects:has/have} in the model as well",
        "remove delay_s there again, so that plans allow for the delay that the robot's program "
        "sees, or undo the adoption with `adopt --undo`",
    ),
    "other_task": Entry(
        "refuse",
        "{about} was made for another task[[ ({what})]][[never? , and was not run there]]",
    ),
    "outdated": Entry(
        "note", "the model was changed since {candidate} was made: its prediction is outdated"
    ),
    "no_better": Entry(
        "note", "the model was changed since {about} was planned, and it promises no better plan"
    ),
    "void": Entry(
        "note",
        "{candidate} was not run and is void[[: {why}]][[: {trials}, which it was made from, "
        "{trials:is/are} {gone}]][[; run {instead} instead]]",
        "[[!other? if the robot has run it meanwhile, ingest that log with --candidate "
        "{candidate}: it counts]]",
    ),
    "lost": Entry(
        "note",
        "{candidate} [[lost with {real:.4g}]][[!real? crashed]]; the best so far is {best}, "
        "{of:.4g}",
    ),
    # what the robot will do
    "time_step": Entry(
        "warn",
        "{about} is missed by {share:%} of its change in a step: the integrator's steps of {step} "
        "are "
        "too long for the model",
        "[[set substeps={substeps} in Model(...)]][[!substeps? make the model less stiff]] in "
        "{file}, and plan or diagnose again",
    ),
    "coasts_out": Entry(
        "warn",
        "after the run its runner holds {held}, and the model predicts that the robot "
        "leaves [safety] {state} = [{low}, {high}] {at} later and reaches {most}",
        STOP + ", switch to a holding controller once the runner is done, or let the target come "
        "to rest inside",
    ),
    # a drive that excites the model's parameters
    "no_drive": Entry(
        "refuse",
        "[[!state? by the model, no drive stays inside [safety] from [task] start]][[state? "
        "[safety] "
        "bounds no state, and no log shows where the robot may go]]",
        "[[!state? start where there is room, make it shorter (--seconds), or widen [safety]]]"
        "[[enter where it may go, such as [safety] {state} = [-1.0, 1.0]]]",
    ),
    "drive_weak": Entry(
        "note",
        "the drive leaves {about} weak",
        "make it longer (--seconds), or hold one of those that only act together constant",
    ),
}
