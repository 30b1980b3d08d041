"""Findings on logs: how one came about, what its run shows, and what its signals are."""

from __future__ import annotations

from grounded.findings.catalogue.entry import Entry, aside, note, refuse, warn

# how a run went can't be judged by a wrong log
JUDGED: tuple[str, ...] = ("run.reversed", "run.safety", "run.start")
# of a run that its program spoilt, neither its end nor its motion says anything of the candidate
OUTCOME: tuple[str, ...] = ("run.reversed", "run.failed", "run.safety")
SPOILT = (*OUTCOME, "run.start")  # of a log that is taken as a run all the same
# what a program should do that sends other commands than those of the candidate
CALL = (
    "call `runner.action` in each control step with the seconds since the run began and the "
    "states as they are logged, send what it returns at once, and run {ran} again"
)
SPAN = "if it began elsewhere, `discard` it and set [log.span] start"


def account(short: str, remedy: str = "", hides: tuple[str, ...] = JUDGED) -> Entry:
    """Return the words of an account of a log, with what shows it and how to take the log anew."""
    proof = (
        "[[; as logged the model misses {state} by {logged}, so by {mended}]][[; only then are "
        "the commands those of {ran}]][[; as likely: a fault of {tied}]][[ (in {which})]]"
    )
    again = "[[; then discard {trials} and {source:log=ingest the log,trial=run it} again]]"
    return aside(short + proof, remedy + again, hides)


# how a log came about, and what is wrong with it
LOG: dict[str, Entry] = {
    # columns: the accounts
    "unit": account(
        "{about} {about:is/are} [[in {unit}, not {own}]][[{times:.4g} times too {size}]][[ and of "
        "{negative}]]",
        "[[multiply the scale in {tables} by {by:.8g} (a missing one is 1)]][[let the program "
        "write {writes}]]",
        hides=(*JUDGED, "log.limits"),
    ),
    "sign": account(
        "{about} {about:is/are} logged with the opposite sign",
        "reverse the sign[[ in {tables} (scale = -1 if it has none)]], or in the model",
    ),
    "compass": account(
        "{about} turns the other way than positions do: it is {angle:.0f} degrees less the logged "
        "value, as on a compass",
        "[[set scale = -1 and that offset in {tables}]]",
    ),
    "exchange": account(
        "{about} look exchanged[[, {reversed} with the other sign]][[; {proven} show no exchange]]",
        "exchange their paths in [log], or correct what wrote the log",
    ),
    "dead": account(
        "{about} shows no motion, only noise around {mean:.4g}, while {state} moves by {moved}",
        "is its sensor on? If it is, look for its column in [log]",
    ),
    "offset": account("{about} is {angle:.0f} degrees off the course given by the positions"),
    "axes": account(
        "{about} are in the axes of the positions, not in body axes",
        "rotate them by -{heading} in log and robot's program, or model speeds in world axes",
    ),
    "pace": account(
        "a second of its stamps is {by:g} s of the run", "multiply the stamps by {by:g}"
    ),
    "clock": account(
        "{state} moves {lead:.3g} s before it is commanded: states and commands have two clocks",
        "subtract {lead:.3g} s from delay_s[[ in {tables}]], or stamp both by one clock",
    ),
    "reversed": refuse(
        "{about} acts the other way round than in {others} ({share:%} of its modelled effect, "
        "there {usual:%}): no model explains both[[ (in {which})]]",
        "was a motor wired otherwise, or a sign switched? Then mend it[[, discard {trials}]] and "
        "run again",
    ),
    "zero": refuse(
        "{about} is {off} too {size} for the commands of {ran}: does its zero differ from that of "
        "the program?",
        "add {add:.3g} to the offset in {tables} (a missing one is 0)",
    ),
    # columns: what [log] and names say
    "path": warn(
        "{about} is read from {path}, {what}[[: {instead} is the angle]]", "check its path in [log]"
    ),
    "limits": warn(
        "{about} goes up to {most} beyond its [limits], {limits}",
        "{how:clip=log the commands after clipping,widen=widen them if the robot can take it}",
    ),
    # what a log lacks
    "gaps": warn(
        "{samples} lost samples were interpolated, the longest gap is {longest} of {about} at {at}"
    ),
    "still": warn(
        "no state changes in it: was the robot switched on, and are these its columns?",
        "`discard {trial}` sets it aside",
    ),
    "late_states": refuse(
        "the run starts {late} before every state is known",
        "start recording before the run, or ingest it with --data",
    ),
    # where a run begins
    "start_assumed": warn(
        "no start of {ran} was found in it: the run is assumed to begin at its first command, at "
        "{at:.3f} s",
        SPAN,
    ),
    "begun_late": refuse(
        "its first row is {late} after {ran} began",
        "record from before the run: without its beginning it can't be judged",
    ),
    # whose run it is
    "not_run": refuse(
        "its commands are not what {ran} sends on the logged states: {about} differs by {rms} "
        "(rms)[[; alike up to {until}]][[; only {lasts} of commands]][[; {guessed} by [estimate] "
        "may be why]]",
        "who drove? Use --data, --candidate {ran} anyway, or set [log.span] start",
        hides=("run.start", "run.reversed"),
    ),
    "silent": refuse(
        "{about} {about:is/are} 0 from the first step to the last, unlike in the plan of {ran}",
        "were the commands recorded? If so, pass `runner.action` the seconds since the run began",
    ),
    "another": refuse(
        "its commands are those of {other}, not of {ran}[[: to {theirs:%}, of {ran} only to "
        "{mine:%}]]",
        "was {ran} copied to the robot? Ingest it with --candidate {other}, or with --data",
    ),
    "earlier": refuse(
        "[[{about} ]]ran {ran}, which [[was made for an earlier task "
        "({was})]][[{what:unknown=this workspace never proposed,policy=is not the policy of this "
        "workspace}]]: its utility can't be compared",
        "ingest it with --data for fit and diagnose[[was? ; or change the task back]]",
    ),
    "late": warn(
        "its commands are those of {ran} {steps:step} {side}: {what:either=its program sent them "
        "late or the log has them late,start=shifted by that they fit better}",
        "log each command when it is sent; if it is, [log.span] start is {steps:step} too "
        "{side:late=early,early=late}",
    ),
    # stored before
    "aside": warn(
        "{about} stays set aside and does not count: `restore {about}` undoes that",
        "[[if you don't want that, run {waits} and record another log]]",
        hides=(*JUDGED[:-1], "run.failed"),
    ),
    "repeats": warn(
        "it repeats {about} to the last bit: either it is a copy, or the system is deterministic",
    ),
    "stored": refuse(
        "{about} is stored already, as {trial}[[ ({used})]][[other?, read in another way]]",
        "[[pass the log of the run of {waits}, or ]]discard {trial} and ingest it again",
    ),
    "not_estimated": refuse(
        "the smoother finds no finite states for this log ({why})",
        "the model is too far off to estimate what was not measured: check its units and [log]",
    ),
    "no_signal": refuse(
        "[log] maps no '{about}'{what:any=, nor any other state,estimated=, but [estimate] lists "
        "it as measured}",
        "{what:input=map it,any=map what is measured,estimated=map it, or remove it "
        "there,state=map it, or let a smoother estimate it}[[ ({path} has {numbers})]][[, with "
        "[estimate] measured = {measured}]]",
    ),
}

# what a run of a candidate shows: of the program, the robot, its start and its end
RUN: dict[str, Entry] = {
    # the program
    "passed": aside(
        "its commands are what {ran} sends if `runner.action` gets [[the time in "
        "{time}]][[{states} in {unit}]][[{states} times {times:.4g}]][[the states as {passed}]]",
        CALL + "[[; it takes {order}]]",
        hides=SPOILT,
    ),
    "unfed": aside(
        "its commands are the feed-forward of {ran} alone, without its feedback",
        "send what `runner.action(t, state)` returns, for a state of numbers only, and run {ran} "
        "again",
        hides=SPOILT,
    ),
    "origin": aside(
        "its commands are what {ran} sends on states from another origin: {off} beside those in "
        "the log",
        CALL,
        hides=SPOILT,
    ),
    "clock": aside(
        "its first command is that of step {step} ({seconds:.3g} s) of {ran}, and the others "
        "follow: its clock began before the run",
        CALL,
        hides=SPOILT,
    ),
    "exchanged": aside(
        "{about} are exchanged on the robot, not in the log: [[it moved {moved}]][[{proven}, read "
        "in the same way, show no exchange]][[; its commands are those of {ran}]]",
        "put its {parts} back in their places[[, discard {trials}]] and run again",
        hides=OUTCOME,
    ),
    "sends": refuse(
        "its program sends {about} times {times:.4g}: [[the robot moved {moved}]][[{proven}, read "
        "in the same way, have it right]]",
        "mend that and run {ran} again",
    ),
    "clipped": aside(
        "its commands are those of {ran} cut inside [limits] in {share:%} of the steps ({at})",
        "if the robot takes no more, set [limits] to that and propose again; if it does, remove "
        "the cut and run {ran} again",
        hides=OUTCOME,
    ),
    "smoothed": aside(
        "its commands are what {ran} sends on {states} smoothed by {share:.2g} of the last value "
        "in each step, {lag:size} late, but the log has them as measured",
        CALL,
        hides=OUTCOME,
    ),
    "unsent": aside(
        "its first {steps:step} sent nothing but what was held before the run, the others the "
        "commands of {ran}",
        CALL,
        hides=OUTCOME,
    ),
    "skipped": aside(
        "its commands change every {every:.3g} ms, dt is {dt:.3g} ms: {lost:%} of the steps of "
        "{ran} were not run, or not logged",
        "call the runner every {dt:.3g} ms, log every command and run {ran} again",
        hides=OUTCOME,
    ),
    # the robot
    "reversed": aside(
        "{about} acted the other way round[[: so the model predicts {state} {times:.2g} times as "
        "well]][[, with -{share:%} of its modelled effect]][[, unlike in {others}]][[, as in "
        "{alike}]]",
        "is it wired the wrong way round, or its sign wrong in model or log[[ ({column})]]? "
        "Then[[ `discard {trial}`,]] mend it and run again; otherwise `propose` goes on",
        hides=(*OUTCOME[1:], "log.limits"),
    ),
    "failed": warn(
        "the run ended after {steps} of {horizon} steps[[large? , with values that are too "
        "large]]: a failed candidate",
        "[[`discard {trial}` if you stopped it, or if only the recording was cut]]",
    ),
    "fell": warn(
        "{about} left [safety] {bound} at {at} (it was {was}, {predicted} was predicted), and "
        "then the commands were no longer those of {ran}: a failed run, cut at {until}",
        "if something disturbed it, `discard` it",
        hides=("run.failed", "run.safety"),
    ),
    # its start
    "start_spoils": aside(
        "the run started with {state} = {began}, the task's start is {start}: {off} off, more "
        "than its noise[[; by the model its whole start changes its utility by {change:+.3g}]]",
        "`discard {trial}`, place the robot nearer and run {ran} again; if it always starts "
        "there, set it in [task] start; else `propose` goes on",
        hides=SPOILT,
    ),
    "start": warn(
        "the run started with {state} = {began}, the task's start is {start}: {off} off[[, as "
        "those of {runs} other runs, off by {rms} (rms)]][[; by the model that changes its "
        "utility by {change:+.3g}]]: the run counts",
        "place the robot nearer to the start, or write in [task] start where it always starts",
    ),
    # its end
    "safety": warn(
        "the run left [safety] {about} = {bound} at {at}: it came to {most}, where {predicted} "
        "was predicted",
    ),
    # the command of [system]
    "by_hand": refuse(
        "grounded.toml has no [system] to run {about} with",
        "run it on your robot by hand and ingest its log, or give [system] command, such as "
        "{example}",
    ),
    "command": refuse(
        "[system] command {about}[[ ended with exit code {exit}]][[ can't be run: {why}]][[ wrote "
        "no trial to {missing}]]",
        "[[what it wrote is kept in {kept}]]",
    ),
    "workers": refuse(
        "{lost} of {total:job} lost their worker ({why})", "run the study again with fewer --jobs"
    ),
    "viewer": refuse(
        "the viewer [[did not start, with exit code {exit}]][[missing? is not "
        "installed]][[screen? has no screen here]]",
        "[[missing? pip install '.[view]' in grounded's own folder, or ]]copy {about} to a "
        "computer with a screen and open it there with `rerun`",
    ),
    # its errors
    "off_target": note(
        "{about}[[ {rms:size} rms, {most:size} at most (at {at} s)]][[also?,]][[ {end:size} at "
        "the end]][[there?  none at the end]][[ at the end within its noise of {noise:size}]]",
    ),
}

# signals: clauses that continue a sentence after the signal's name
SENSOR: dict[str, Entry] = {
    "late": warn(
        "[[{by} later than ]][[tau? follows ]][[derivative? the derivative of ]][[{of}]][[ "
        "through a filter of {tau:.3g} s]][[is older by another {more:.3g} s, by which the log of "
        "{position} itself is late]][[is in one message with, and so as late as, {message}]]",
    ),
    "derived": note(
        "is a filtered derivative of {of}, {age:.2g} s behind it on average; left out of the "
        "diagnosis",
    ),
    "scale": warn(
        "shows [[{share:%} of]][[{size} {way} than]] the rate of {of}[[rpm? , 2 pi / 60 times it: "
        "it was probably converted from rpm by mistake]][[!rpm? ; either may be wrong]]",
    ),
    "samples": warn(
        "[[jumps by a full turn {count:time}]][[drops to {low} for single samples]][[has a new "
        "value only every {every:.3g} s]][[sticks to its last value, up to {stuck:.3g} s at "
        "a time, and then jumps]][[ ({share:%})]]",
    ),
    "mismatch": warn("does not move as {of} {of:implies/imply} (its rate is off by {off})"),
    "unresolved": warn(
        "reaches {reach} in {trial}: from {at} on, the model can't be integrated with time steps "
        "of {step}, and the rest of that trial is left out",
    ),
    # how to mend it for good
    "mend": note(
        "{about} can be mended for good",
        "[[treat it as {of}: ]]if the robot's program gets it as late, `adopt` sensor_delay; else "
        "set {log} in its table of [log]; not both",
    ),
}
