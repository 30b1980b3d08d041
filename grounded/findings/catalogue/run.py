"""Findings on what a run of a candidate shows: of the program, the robot, its start and its end."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

OF = "[[{log}: ]]"  # the file, where the log is refused
# of a run that its program spoilt, neither its end nor its motion says anything of the candidate
OUTCOME: tuple[str, ...] = ("run.reversed", "run.astray", "run.early", "run.failed", "run.safety")
SPOILT = (*OUTCOME, "run.start")  # of a log that is taken as a run all the same
# what a program should do that sends other commands than those of the candidate
CALL = (
    "call `runner.action` in each control step with the seconds since the run began and the states "
    "as they are logged, send what it returns at once, and run {ran} again"
)
ANEW = "`discard {trial}` and run {ran} again; if it ran as it should, `propose` goes on"

ENTRIES: dict[str, Entry] = {
    # the program
    "passed": Entry(
        "aside",
        OF + "its commands are what {ran} sends if `runner.action` gets [[the time in {time}]]"
        "[[{states} in {unit}]][[{states} times {times:.4g}]][[the states as {passed}]]",
        CALL + "[[; it takes {order}]]",
        hides=SPOILT,
    ),
    "unfed": Entry(
        "aside",
        OF + "its commands are the feed-forward of {ran} alone, without its feedback",
        "send what `runner.action(t, state)` returns, for a state that holds numbers only "
        "(`runner.blind` counts the calls without), and run {ran} again",
        hides=SPOILT,
    ),
    "origin": Entry(
        "aside",
        OF + "its commands are what {ran} sends on states from another origin: {off} beside those "
        "in the log",
        CALL,
        hides=SPOILT,
    ),
    "clock": Entry(
        "aside",
        OF + "its first command is that of step {step} ({seconds:.3g} s) of {ran}, and the others "
        "follow: its clock began before the run",
        CALL,
        hides=SPOILT,
    ),
    "exchanged": Entry(
        "aside",
        OF + "{about} are exchanged on the robot, not in the log: [[it moved {moved}]][[{proven}, "
        "read in the same way, show no exchange]][[; its commands are those of {ran}]]",
        "put its {parts} back in their places[[, discard {trials}]] and run again",
        hides=OUTCOME,
    ),
    "sends": Entry(
        "refuse",
        OF + "its program sends {about} times {times:.4g}: [[the robot moved {moved}]][[{proven}, "
        "read in the same way, have it right]]",
        "mend that and run {ran} again",
    ),
    "clipped": Entry(
        "aside",
        OF + "its commands are those of {ran} cut inside [limits] in {share:%} of the steps ({at})",
        "if the robot takes no more, set [limits] to that and propose again; if it does, remove "
        "the cut and run {ran} again",
        hides=OUTCOME,
    ),
    "smoothed": Entry(
        "aside",
        OF + "its commands are what {ran} sends on {states} smoothed by {share:.2g} of the last "
        "value in each step, {lag:size} late, but the log has them as measured",
        CALL,
        hides=OUTCOME,
    ),
    "unsent": Entry(
        "aside",
        "its first {steps:step} sent nothing but what was held before the run, the others the "
        "commands of {ran}",
        CALL,
        hides=OUTCOME,
    ),
    "missed": Entry(
        "warn",
        "the first command in the log is that of step {steps} of {ran}: those before were not sent "
        "or not logged[[, and {held} held until then]]",
        CALL,
    ),
    "skipped": Entry(
        "aside",
        "its commands change every {every:.3g} ms, dt is {dt:.3g} ms: {lost:%} of the steps of "
        "{ran} were not run, or not logged",
        "call the runner every {dt:.3g} ms, log every command and run {ran} again; or set [task] "
        "dt to what the robot can",
        hides=OUTCOME,
    ),
    # the robot
    "reversed": Entry(
        "aside",
        OF + "{about} acted the other way round[[: so the model predicts {state} {times:.2g} times "
        "as well]][[, with -{share:%} of its modelled effect]][[, unlike in {others}]][[, as in "
        "{alike}]]",
        "is it wired the wrong way round, or its sign wrong in the model or the log[[ ({column} "
        "reads another column now)]]? Then[[ `discard {trial}`,]] mend it and run again; "
        "otherwise `propose` goes on",
        hides=(*OUTCOME[1:], "log.limits"),
    ),
    "astray": Entry(
        "aside",
        "it missed its prediction by {missed:,.3g}, {times:,.2g} times what runs miss otherwise",
        ANEW,
        hides=OUTCOME[2:],
    ),
    "early": Entry(
        "aside",
        "all states are known for {steps} of {horizon} steps only[[, {silent} not after that]]; "
        "the robot was as near to its prediction there as before[[ ({ran} ran to the end in "
        "{complete})]]: was the recording cut off, or the robot stopped?",
        "`discard {trial}` and run {ran} again; if it crashed, `propose` goes on",
        hides=SPOILT[3:],
    ),
    "failed": Entry(
        "warn",
        "the run ended after {steps} of {horizon} steps[[large? , with values that are too "
        "large]]: a failed candidate[[ ({silent} unknown "
        "after that)]][[, though {complete} ran to the end]]",
        "[[`discard {trial}` if you stopped it for another reason, or if only the recording was "
        "cut]]",
    ),
    "fell": Entry(
        "warn",
        OF + "{about} left [safety] {bound} at {at} (it was {was}, {predicted} was predicted), and "
        "then the commands were no longer those of {ran}: a failed run, cut at {until}",
        "if something disturbed it, `discard` it",
        hides=("run.early", "run.failed", "run.safety"),
    ),
    "asked": Entry(
        "aside",
        "it did not run {ran} as it should, as `ingest` told",
        ANEW,
    ),
    # its start
    "start_spoils": Entry(
        "aside",
        "the run started with {state} = {began}, the task's start is {start}: {off} off, more than "
        "its noise[[; by the model its whole start changes its utility by {change:+.3g}]]",
        "`discard {trial}`, place the robot nearer and run {ran} again; if it can't be placed "
        "nearer, `propose` goes on; if it always starts there, set it in [task] start",
        hides=SPOILT,
    ),
    "start": Entry(
        "warn",
        "the run started with {state} = {began}, the task's start is {start}: {off} off[[, as "
        "those of {runs} other runs, off by {rms} (rms)]][[; by the model "
        "that changes its utility by {change:+.3g}]]: the run counts",
        "place the robot nearer to the start next time, or write in [task] start where it always "
        "starts, and propose again",
    ),
    # its end
    "safety": Entry(
        "warn",
        "the run left [safety] {about} = {bound} at {at}: it came to {most}, where {predicted} was "
        "predicted",
    ),
    # the command of [system]
    "by_hand": Entry(
        "refuse",
        "grounded.toml has no [system] to run {about} with",
        "run it on your robot by hand and ingest its log, or give [system] command, such as "
        "{example}",
    ),
    "command": Entry(
        "refuse",
        "[system] command {about}[[ ended with exit code {exit}]][[ can't be run: {why}]][[ wrote "
        "no trial to {missing}]]",
        "[[what it wrote is kept in {kept}]]",
    ),
    "workers": Entry(
        "refuse",
        "{lost} of {total:job} lost their worker ({why})",
        "run the study again with fewer --jobs",
    ),
    "viewer": Entry(
        "refuse",
        "the viewer [[did not start, with exit code {exit}]][[missing? is not installed]][[screen? "
        "has no screen here]]",
        "[[missing? pip install '.[view]' in grounded's own folder, or ]]copy {about} to a "
        "computer "
        "with a screen and open it there with `rerun`",
    ),
    # its errors
    "off_target": Entry(
        "note",
        "{about}[[ {rms:size} rms, {most:size} at most (at {at} s)]][[also?,]]"
        "[[ {end:size} at the end]][[there?  none at the end]][[ at the end within its noise of "
        "{noise:size}]]",
    ),
}
