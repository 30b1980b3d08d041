"""Findings of a diagnosis: the gap between model and log, its causes, and the next trial."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

DIAGNOSE = "then diagnose again"
FIX = "fix the program that writes {about}, and discard the trials that the search learned from"

ENTRIES: dict[str, Entry] = {
    # the three lines of a diagnosis
    "causes": Entry(
        "note",
        "{causes}[[; and {more:smaller cause}]][[tied?; one of these ties with another cause]]"
        "[[left?; a gap remains beside this]]",
    ),
    "none": Entry(
        "note",
        "the model explains these trials[[known?  down to the noise]][[adopted?  as adopted]]",
    ),
    "unknown": Entry(
        "note",
        "no known effect explains what the model leaves[[noise?, which may be noise]]"
        "[[groups?  if both groups get the same values]]",
    ),
    "too_few": Entry("note", "no cause can be named from these trials"),
    "refused": Entry("warn", "the logs were refused: {why}"),
    "errors": Entry(
        "note",
        "[[whole?over whole trials]][[{ahead:.3g} s ahead]] {who} misses {state} by {now:size}"
        "[[ instead of {before:size}]][[ (noise: {bound:yes=at most ,no=}{noise:size})]]"
        "[[, {state2} by {now2:size}]][[ instead of {before2:size}]][[inside?, not held out]]",
    ),
    "left": Entry(
        "note",
        "unexplained: [[{state} is off by {error:size} {ahead:.3g} s ahead]]"
        "[[the rate of {rate} lacks something small but lasting]][[, {size} rms]]"
        "[[ (noise: {bound:yes=at most ,no=}{noise:size})]][[, mostly where {place}]]"
        "[[, {part:%} of it in {trial} from {start:.3g} to {end:.3g} s]]"
        "[[; {others:more state} {others:is/are} off]]",
    ),
    "where": Entry(
        "note",
        "the gap is {share:%} in {state}[[ and {share2:%} in {state2}]]"
        "[[, {part:%} of it where {place}]]",
    ),
    # what else is found
    "changed": Entry(
        "warn",
        "[[{value} changed from {first} to {second} between the two groups of trials]]"
        "[[!value? nothing changed between the two groups beyond the noise]]",
    ),
    "tie": Entry(
        "warn",
        "these trials can't tell {effect} from {others}: each explains them",
        "[[own?adopting writes {effect}]]",
    ),
    "equivalent": Entry(
        "note",
        "no log can tell {effect} from {others} in this model; plans are the same for all",
    ),
    "worse": Entry(
        "warn",
        "predictions of {state} get worse [[{ahead:.3g} s ahead]][[whole? over whole trials]]: "
        "{now:size} instead of {before:size}",
    ),
    "disagree": Entry(
        "warn",
        "the trials disagree on {quantity} of {effect}: {low} in {trial}, {high} in {trial2}",
    ),
    "one_motion": Entry(
        "note", "all trials repeat one motion: these values may not hold for another"
    ),
    "unconfirmed": Entry(
        "note",
        "unconfirmed: {effect} ({values}), which {seen} of {trials} trials show, all of one group",
    ),
    "small": Entry(
        "note",
        "{state} is off by {error:size} [[{ahead:.3g} s ahead]][[whole?over whole trials]], "
        "{times:.2g} times the noise but {share:%} of the error before: too little to find a cause",
    ),
    "noise": Entry(
        "note",
        "how much of the error of {state} is noise is not known",
        "repeat one run to know it",
    ),
    "correction": Entry(
        "note",
        "a curve over {over} predicts {gain:%} of what no effect explains: no cause, but "
        "correction:{state} can be adopted",
    ),
    "more": Entry(
        "note",
        "[[{most:cause} {most:is/are} named, as many as were looked for, and more is left]]"
        "[[interrupted? interrupted while it looked for one more effect]]",
        "adopt these and diagnose again[[most?, or allow more with --max-effects]]",
    ),
    "sign": Entry(
        "warn",
        "{input} acts the other way round",
        "flip its sign in model.py; if only the log has it so, multiply the scale in "
        f"[log.input.{{input}}] by -1 and ingest the logs again; {DIAGNOSE}",
    ),
    "corrected": Entry(
        "warn",
        "corrected here, but not in the stored trials: {about}",
        FIX,
    ),
    # the next step: one of them
    "next.record": Entry(
        "note",
        "[[diagnose all: {stored:stored trial} of this task can be diagnosed as well]]"
        "[[!stored? run another trial, or record a longer log, in which every input changes]]",
    ),
    "next.none": Entry(
        "note",
        "no trial is needed[[adopted?: nothing more is found]][[ for the manoeuvre: the search has "
        "ended, with {candidate}]]",
    ),
    "next.adopt": Entry(
        "note",
        "no trial is needed: adopt the claimed causes[[left?; a diagnosis after it may tell more]]",
    ),
    "next.doubt": Entry(
        "note",
        "adopt nothing yet: {why:worse=predictions get worse,little=predictions gain little,"
        "disagree=the trials disagree} with {about}",
        f"run another trial, {DIAGNOSE}",
    ),
    "next.changed": Entry(
        "note",
        "the robot changed between the two groups: adopt no value of both",
        "diagnose the newer trials alone",
    ),
    "next.flip": Entry("note", f"flip the sign of {{input}}, {DIAGNOSE}"),
    "next.apart": Entry(
        "note",
        "run a trial that may tell {effect} from {others}: small and large inputs of each sign, "
        "slow and fast",
    ),
    "next.confirm": Entry(
        "note",
        "run a trial of another motion or condition that shows {effect}",
    ),
    "next.look": Entry(
        "note",
        "look at the recording of {trial} from {start:.3g} to {end:.3g} s",
        "if the robot was held or pushed then, discard it and ingest its log without that part",
    ),
    "next.repeat": Entry(
        "note",
        "[[run {candidate} twice more]][[log? record one run three times with the same inputs]], "
        "to see how much of the error of {state} is noise",
    ),
    "next.elsewhere": Entry(
        "note",
        "run a trial[[ that spends more time where {place}]][[ with other steps and sweeps of "
        "{inputs}]], to see what {state} lacks",
    ),
    "next.fix": Entry("warn", FIX),
    "next.probe": Entry(
        "note",
        "[[run {candidate}, ]]{probe}: expected to tell {effect} from {others} by {by:.3g} nats",
    ),
    "no_probe": Entry(
        "note",
        "no probe[[ ({why})]][[!why?: none that was tried stays inside [safety] and near the "
        "trials]]",
    ),
    "next.no_probe": Entry(
        "note",
        "no run inside the limits would tell {effect} from {others}",
        "[[claimed? adopt {claimed}]][[!claimed? record larger inputs or another manoeuvre]]",
    ),
}
