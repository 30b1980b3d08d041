"""Findings on where the search stands, and how it ended."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

MODEL = "a diagnosis may show what the model lacks"

ENTRIES: dict[str, Entry] = {
    # it goes on
    "first": Entry(
        "note",
        "[[!crashed? the first candidate is the model's own policy]][[{crashed} crashed: the next "
        "first policy is gentler]]",
    ),
    "step": Entry(
        "note",
        "improve on {best} with {step}[[, since {crashed} crashed]]",
    ),
    # it waits
    "waiting": Entry("note", "{candidate} is waiting for {missing:trial}"),
    "in_doubt": Entry(
        "note",
        "{loser} lost to {best}[[ by {loss}]][[, but by the model {start} of that is due to where "
        "the runs began]][[known? by no more than noise may explain]]: {candidate} is waiting for "
        "another trial[[. {loser} promises {share:%} of what {best} costs: if that "
        "is not worth a run, stop with {best} (`export best`)]]",
    ),
    "discard_first": Entry(
        "note", "discard {trial}, a run of {candidate}, or go on with it: `propose`"
    ),
    "to_robot": Entry(
        "note",
        "[[ended? the search has ended with {about}]][[!ended? copy both files to the robot, run "
        "{about} and record a log]]",
    ),
    # it has ended with a result
    "no_step": Entry(
        "note",
        "no step improved on {best}[[ down to alpha = {alpha:.6g}]][[ in the last {last} "
        "candidates]][[ ({lost} lost)]][[; the next promises {gain}, with a likely error of "
        "{error}]][[; the model promises less than {least:%} from smaller steps]]: "
        "{best} is the result",
    ),
    "little": Entry(
        "note",
        "the last {last} candidates gained {gain:.3g} in total, less than [[{least:%} each "
        "([search] tolerance)]][[its standard error of {error:.2g}]]: "
        "{best} is the result",
    ),
    # it has ended without one
    "used_up": Entry(
        "note",
        "{used} of {most} trials are used up[[; a candidate needs {needs}]] ([search] max_trials)",
    ),
    "crashed": Entry(
        "note",
        "the first policy crashed {crashes} times, although each was gentler: the model is too "
        "inaccurate to start from",
        MODEL,
    ),
    "diverges": Entry(
        "note",
        "the model grounded on {best} [[!least? diverges for every step]][[loses with every step, "
        "by at least {least:.4g}]]: it is too inaccurate there to improve with",
    ),
    # what helps more than the next trial
    "lost_in_row": Entry("note", "{lost} steps in a row did not improve", MODEL),
    "crashes": Entry("note", "{crashes} policies crashed in a row", MODEL),
    "far_off": Entry(
        "note",
        "{candidate} [[gave {real:.4g}]][[!real? failed]], but {promised:.4g} was predicted",
        MODEL,
    ),
    "within_model": Entry(
        "note",
        "the model alone reaches {promised:.4g}, {by:.3g} more than the {real:.4g} of {best}",
        MODEL,
    ),
    "diagnose": Entry("note", MODEL),
    "adopt_first": Entry(
        "note",
        "a better model may gain more: adopt what this one lacks",
    ),
    # what status tells beside it
    "uncounted": Entry(
        "note",
        "{about} {about:counts/count} only as data, for fit and diagnose: {about:it/they} ran "
        "another task's candidate, a probe, or another policy of a candidate's name",
    ),
    "left_out": Entry(
        "note",
        "{about} {about:has/have} [[other states or inputs than {model}]][[a sampling interval of "
        "{was}, and [task] dt is {now}]]: fit, diagnose and the search leave {about:it/them} out",
    ),
    "outdated": Entry(
        "note",
        "the last diagnosis is outdated[[; [log] reads {reread} in another way now]][[; it had "
        "{used} of {usable} trials]][[; adopted since: {adopted}]][[, but not {missing}]]"
        "[[changed? ; the model was changed]]",
    ),
    "stops": Entry(
        "note",
        "learn stops here, since the next plan would be based on this log",
        "fix it first, or run `learn` again if the warning is wrong",
    ),
    # names
    "aside": Entry("refuse", "{about}[[, a run of {candidate},]] is set aside[[ ({why})]]"),
    "unknown": Entry(
        "refuse",
        "{about} is no {kind} of this [[unusable? task, by its length, states, inputs or dt]]"
        "[[!unusable? workspace]][[; did you mean '{meant}'?]][[; there are: "
        "{known}]]",
    ),
    "no_trial": Entry(
        "refuse",
        "there is no trial to learn from",
        "ingest runs of candidates, or other logs with --data",
    ),
    "none_waits": Entry(
        "refuse",
        "[[{log} does not say which candidate it ran, and ]]no candidate is waiting for a trial",
        "[[log? name it with --candidate ID, or use --data for a log that ran none]][[!log? make "
        "the next one, or name the candidate that is run]]",
    ),
    "undiagnosed": Entry("refuse", "there is no diagnosis[[ of {about}]] yet", "diagnose first"),
    # how sure a gain is
    "gain": Entry(
        "note",
        "the last gain in utility, of {after} over {before}, is {gain}[[, an improvement with "
        "probability {probability:.2f}]][[exact? ; repeated trials "
        "agree exactly]][[single? ; runs of similar utility were not repeated, so their noise is "
        "unknown]][[; by the model {start:.3g} of it is due to where their runs began, and "
        "{own:.3g} to the policy]][[apart? , but "
        "their runs began apart, and what that is worth is not known]]",
    ),
    "better": Entry(
        "note",
        "{share:%} {better:1=better,0=worse} than the model's own policy[[, +- {error:%}]][[; by "
        "the model, different start states alone changed the cost by {start:%}]]",
    ),
    "lead": Entry(
        "note",
        "the scatter of runs, or where they began, may explain its lead on the model's own policy",
    ),
}
