"""Findings on how a log came about, and what is wrong with it."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

OF = "[[{log}: ]]"  # the file, where the log is refused
IN = "[[ (in {which})]]"
MOTION = "[[; as logged the model misses {state} by {logged}, so by {mended}]]"
RAN = "[[; only then are the commands those of {ran}]]"
TIED = "[[; as likely: a fault of {tied}]]"
AGAIN = "[[; then discard {trials} and {source:log=ingest the log,trial=run it} again]]"
SCALE = "[[multiply the scale in {tables} by {by:.8g} (a missing one is 1)]]"
SPAN = "if it began elsewhere, `discard` it and set [log.span] start"
WRITES = "[[let the program write {writes}]]"
# how a run went can't be judged by a wrong log
RUN: tuple[str, ...] = ("run.reversed", "run.astray", "run.early", "run.safety", "run.start")

ENTRIES: dict[str, Entry] = {
    # columns: the accounts
    "unit": Entry(
        "aside",
        OF + "{about} {about:is/are} [[in {unit}, not {own}]][[{times:.4g} times too {size}]]"
        "[[ and of {negative}]]" + MOTION + RAN + TIED + IN,
        SCALE + WRITES + "[[, and in [limits] {limits}]]" + AGAIN,
        hides=(*RUN, "log.limits", "log.stated"),
    ),
    "sign": Entry(
        "aside",
        OF + "{about} {about:is/are} logged with the opposite sign" + MOTION + RAN + TIED + IN,
        "reverse the sign[[ in {tables} (scale = -1 if it has none)]], or in the model if the log "
        "is right" + AGAIN,
        hides=RUN,
    ),
    "compass": Entry(
        "aside",
        "{about} turns the other way than positions do: it is {angle:.0f} degrees less the logged "
        "value, as on a compass" + TIED + IN,
        "[[set scale = -1 and that offset in {tables}]]" + AGAIN,
        hides=RUN,
    ),
    "exchange": Entry(
        "aside",
        OF
        + "{about} look exchanged[[, and {reversed} of the other sign]]"
        + MOTION
        + RAN
        + "[[; {proven} show no exchange]]"
        + TIED
        + IN,
        "exchange their paths in [log], or correct what wrote the log" + AGAIN,
        hides=RUN,
    ),
    "dead": Entry(
        "aside",
        OF
        + "{about} shows no motion, only noise around {mean:.4g}, while {state} moves by {moved}"
        + TIED
        + IN,
        "is its sensor on? If it is, look for its column in [log]" + AGAIN,
        hides=RUN,
    ),
    "offset": Entry(
        "aside",
        OF + "{about} is {angle:.0f} degrees off the course given by the positions" + IN,
        "[[then discard {trials} and {source:log=ingest the log,trial=run it} again]]",
        hides=RUN,
    ),
    "axes": Entry(
        "aside",
        "{about} are in the axes of the positions, not in body axes" + TIED + IN,
        "rotate them by -{heading}, in the log and in the robot's program, or write the model with "
        "speeds in world axes" + AGAIN,
        hides=RUN,
    ),
    "pace": Entry(
        "aside",
        OF + "a second of its stamps is {by:g} s of the run" + MOTION + RAN + TIED + IN,
        "multiply the stamps by {by:g}" + AGAIN,
        hides=RUN,
    ),
    "clock": Entry(
        "aside",
        "{state} moves {lead:.3g} s before it is commanded: the clocks of states and commands "
        "differ (with later commands the model misses it by {mended}, not {logged})" + IN,
        "subtract {lead:.3g} s from delay_s[[ in {tables}]], or stamp both by one clock" + AGAIN,
        hides=RUN,
    ),
    "reversed": Entry(
        "refuse",
        "{about} acts the other way round than in {others} ({share:%} of its modelled effect, "
        "there {usual:%}): no model explains both" + IN,
        "was a motor wired otherwise, or a sign switched? Then mend it[[, discard {trials}]] and "
        "run again; if only the log has the other sign, correct that",
    ),
    "zero": Entry(
        "refuse",
        OF + "{about} is {off} too {size} for the commands of {ran}: does its zero differ from "
        "that of the program?",
        "add {add:.3g} to the offset in {tables} (a missing one is 0)",
    ),
    # columns: what [log] and names say
    "path": Entry(
        "warn",
        OF + "{about} is read from {path}, {what}[[: {instead} is the angle]]",
        "check its path in [log]",
    ),
    "stated": Entry(
        "warn",
        "{about} is read without a scale from a column in {unit}, but the model has {own}",
        "set scale = {by:.6g} in {table}, if so",
    ),
    "unread": Entry(
        "note",
        "{about} is in [log], but not in [estimate] measured: the trial has an estimate in its "
        "place",
        "to use it, add {about} = its scatter at standstill there",
    ),
    "limits": Entry(
        "warn",
        "{about} goes [[from {logged}]][[up to {most}]] beyond its [limits][[, {limits}]] in this "
        "log",
        "[[most? log the commands after clipping]][[{how:flip=its scale in "
        "[log] is negative: multiply these limits by -1 too,widen=no plan will use that: widen "
        "them if the robot can take it}]]",
    ),
    # what a log lacks
    "gaps": Entry(
        "warn",
        "{samples} lost samples were interpolated, the longest gap is {longest} of {about} at {at}",
    ),
    "short": Entry(
        "warn",
        "the log ends after {steps} of {horizon} steps[[, {missing:.3g} ms before the plan's last "
        "state]]: the rest is extrapolated",
        "log at least one more row after the last command",
    ),
    "still": Entry(
        "warn",
        "no state changes in it: was the robot switched on, and are these its columns?",
        "`discard {trial}` sets it aside",
    ),
    "late_states": Entry(
        "refuse",
        OF + "the run starts {late} before every state is known",
        "start recording before the run[[, and remove {put_off} unless the clocks differ]]; or "
        "ingest it with --data",
    ),
    # where a run begins
    "from": Entry(
        "note",
        "it is used from {at:.3f} s on, as if {name} had been {value:.4g} before: what was sent "
        "before the log is not in it",
        "if {name} was 0, add a row before it that says so, or ingest it with `--before {name}=0`: "
        "it then begins with the step, from which a delay or a lag can be told",
    ),
    "start_doubt": Entry(
        "warn",
        "where {ran} begins is in doubt: its commands fit as well from {rival:.3f} s of the log on "
        "as from {used:.3f} s, which is used",
        SPAN,
    ),
    "start_loose": Entry(
        "warn",
        "the start of the run is only known to {loose:size}, the time between rows",
        "log the states that the controller used, or when it sent each command",
    ),
    "start_assumed": Entry(
        "warn",
        "no start of {ran} was found in it: the run is assumed to begin where the commands first "
        "change, at {at:.3f} s[[, {longer:.3g} s before a run must]]",
        SPAN,
    ),
    "begun_late": Entry(
        "refuse",
        OF + "its first row is {late} after {ran} began",
        "record from before the run: without its beginning it can't be judged. If nothing was cut "
        "off, the program's clock began before the run",
    ),
    # whose run it is
    "not_run": Entry(
        "refuse",
        "[[{log} did not run {ran}: ]]its commands are not what {ran} sends on the logged states: "
        "{about} differs by {rms} (rms)[[; alike "
        "up to {until}]][[; only {lasts} of commands]][[; {guessed} by [estimate] may be why]]",
        "who drove? Use --data, --candidate {ran} anyway, or set [log.span] start",
        hides=("log.start_doubt", "log.start_loose", "run.start", "run.reversed"),
    ),
    "silent": Entry(
        "refuse",
        OF
        + "{about} {about:is/are} 0 from the first step to the last, unlike in the plan of {ran}",
        "were the commands recorded? If they were, pass `runner.action` the seconds since the run "
        "began",
    ),
    "another": Entry(
        "refuse",
        "[[{log} ]]did not run {ran}: its commands are those of {other}[[ to {theirs:%}, of {ran} "
        "only to {mine:%}]]",
        "was {ran} copied to the robot? Ingest it with --candidate {other}, or with --data",
    ),
    "earlier": Entry(
        "refuse",
        "[[{about} ]]ran {ran}, which [[was made for an earlier task ({was})]]"
        "[[{what:unknown=this workspace never proposed,policy=is not the policy of this "
        "workspace}]]"
        ": its utility can't be compared",
        "ingest it with --data for fit and diagnose[[was? ; or change the task back]]",
    ),
    "late": Entry(
        "warn",
        "its commands are those of {ran} {steps:step} {side}: {what:either=its program sent them "
        "late or the log has them late,start=shifted by that they fit better}",
        "log each command when it is sent; if it is, [log.span] start is {steps:step} too "
        "{side:late=early,early=late}",
    ),
    # stored before
    "again": Entry(
        "note",
        "no candidate is waiting for a trial; its commands are those of {ran}, the best: it counts "
        "as another run of it",
    ),
    "before": Entry(
        "note",
        "it was stored before, as {about} ({ran}), which is set aside[[used? : it is used as that "
        "again]]",
        "if it ran another candidate, name that with --candidate ID",
    ),
    "aside": Entry(
        "warn",
        "{about} stays set aside and does not count: `restore {about}` undoes that",
        "[[if you don't want that, run {waits} and record another log]]",
        hides=(*RUN[:-1], "run.failed", "run.asked"),
    ),
    "repeats": Entry(
        "warn",
        "it repeats {about} to the last bit[[: {copy:True=other trials of one candidate differ and "
        "it is probably a copy,False=the system is treated as deterministic and no candidate is "
        "run a second time from now on}]]",
    ),
    "stored": Entry(
        "refuse",
        "{about} is stored already, as {trial}[[ ({used})]][[other?, read in another way "
        "(another [log], [estimate], [task] dt or --before)]]",
        "[[pass the log of the run of {waits}]][[both?, or, ]][[wanted? if it is {wanted} all the "
        "same, discard {trial} and ingest it again]]"
        "[[other? discard {trial} and ingest it again]]",
    ),
    "not_estimated": Entry(
        "refuse",
        "the smoother finds no finite states for this log ({why})",
        "the model is too far off to estimate what was not measured: check its units and [log]",
    ),
    "no_signal": Entry(
        "refuse",
        "[log] maps no '{about}'{what:any=, nor any other state,estimated=, but [estimate] lists "
        "it as measured}",
        "{what:input=every input must be logged: map it,any=map what is measured,estimated=map "
        "it, or remove it there,state=map it, or let a smoother estimate it}[[ ({path} has "
        "{numbers})]][[, with the noise of each measured state under [estimate]: measured = "
        "{measured}]]",
    ),
}
