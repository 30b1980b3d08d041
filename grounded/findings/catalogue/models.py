"""Findings on the model: what data tell of it, and a diagnosis of its gap to the logs."""

from __future__ import annotations

from grounded.findings.catalogue.entry import Entry, note, refuse, warn

DIAGNOSE = "then diagnose again"
FIX = "fix the program that writes {about}, and discard the trials that the search learned from"

# the model: what the data can't tell of it, its parameters, its adopted effects
MODEL: dict[str, Entry] = {
    # what the trials can't show
    "few": warn(
        "[[{steps:step} in all are]][[!steps? one trial alone is]] too few to tell an effect from "
        "noise",
        "record {needed:step} or more[[!steps? , or a second trial]]",
    ),
    "still": warn("{about} never changed, so effects on {about:it/them} can't be identified"),
    "unmeasured": note("{about} {about:was/were} never measured"),
    "share": note(
        "of {total:,} [[stretches? stretches]][[!stretches? steps]] {used:,} were used[[, in "
        "{kept} of {trials} trials]][[stretches?, those with most motion]]",
    ),
    "copy": warn("{about} equals {first}: a copy, or no noise at all; it counts once"),
    # its parameters
    "off": note("[[{values}]][[!values?{names} {names:is/are} off]]"),
    "given": note(
        "{about} {about:is/are} known only [[if {rests} {rests:is/are} right as "
        "declared]][[!rests? together with the others]]",
    ),
    "not_told": note(
        "the trials do not tell {about}, which {about:stays/stay} as {about:it was/they were}[[, "
        "{kept}; the effects were fitted with {value}]]",
    ),
    "at_bound": warn(
        "{about} stopped at {about:its/their} bound or std, and the trials ask for more",
        "widen it in the model file, or diagnose what the model lacks",
    ),
    "unneeded": note(
        "the adopted {effect} may be none ({value})",
        "remove it from [model] effects and diagnose again to see whether it is missed",
    ),
    "sensor": note(
        "[[a gear between {rate} and it]][[!rate? a mount out of level]] would look the same in "
        "any log as the error of the sensor of {about}",
        "measure it before you correct the sensor",
    ),
    # a fit
    "fitted": note(
        "[[{settled:yes=converged,no=still rising}, from {samples:sample}]][[no_better? ; the "
        "values before are as likely, or predict held-out trials as well]]",
    ),
    "fit_worse": refuse(
        "the fitted values predict held-out trials worse ({state} {ahead:.3g} s ahead: {now:size} "
        "instead of {before:size}); they make up for something that the model lacks",
    ),
    "times": note(
        "[[{about} kept {about:its/their} d, which the intervals take as exact]][[!about? times "
        "are known to]][[ {rows:.3g} s between rows of the log]][[ {early:.2g} s by the "
        "interpolation of states]][[!about?  at best, which is in their intervals]]",
    ),
    # an adoption
    "adopted": note("adopted: {about}"),
    # taken home
    "no_place": warn(
        "{about}[[ = {value}]] has no place in the file[[: {equation}, with {values}]]",
        "add it to the program that [[values? steps]][[!values? loads]] the model",
    ),
    "reads": note("the file reads {about}", "put {about:it/them} beside it"),
    "other_form": refuse(
        "{about} can't be written: the model comes from [[{source}, which stays as it "
        "is]][[!source? no file of its own]]",
        "name a file with the ending of the one that model.py names",
    ),
    # what can't be adopted, or undone
    "not_adoptable": refuse(
        "{about} can't be adopted: {why:adopted=it stands in [model] effects already,rival=it was "
        "fitted instead of what is claimed, not with it,worse=it does not predict trials better "
        "that it was not fitted to,together=it was fitted together with,unvalued=the diagnosis "
        "lacks its value}[[ {effect}]]",
        "{why:rival=adopt the claimed, or one alone,worse=run more trials and diagnose "
        "again,together=adopt them together}",
    ),
    "edited": refuse(
        "[[[model] in {about} was changed after {adopted} was adopted, which undoing would "
        "lose]][[!adopted? no adoption is left to undo]]",
        "edit it by hand[[; before the adoption it had {had}]][[; it has {effects}]]",
    ),
    # its file
    "fails": refuse(
        "{about}[[ line {line}]]: {why}",
        "[[called? it is called with states, inputs and parameters: (s, a, p)]]",
    ),
    "not_finite": refuse(
        "the predictions of {about} are not finite[[: {trial}, t = {at}, {values}]]",
        "[[!at? fit its parameters, or check their units]][[at? bound the argument of a square "
        "root or a logarithm in the model (np.maximum(x, 0))]]",
    ),
    "differs": refuse(
        "{about}: the [[!by? trace]][[by? jacobian]] of '{state}' differs from the function[[, "
        "{ours} and {own}]][[ by '{by}', by {off:.3g}]]",
        "[[by? leave jacobian out to difference the step]][[!by? does it use random numbers, a "
        "memory, or the type of its arguments?]]",
    ),
    "undefined": refuse(
        "{about} does not define `model = Model(...)`",
        "[[rename '{other}' to 'model']][[!other? see the README for an example]]",
    ),
    "name_only": refuse(
        "{about}: '{name}' names one of the {what}s, which can't be assigned to",
        "use a local variable",
    ),
    "returns": refuse(
        "{about}: the model must return a dict of all states[[ ({states}), not a {type}]][[; "
        "missing: {missing}]]",
    ),
    "untraced": refuse(
        "{why}",
        "[[long? write it with fewer steps, or give the model as step=, which is run as it "
        "is]][[!long? use np.where: that holds for these parameters only]]",
    ),
    # models that are compared
    # an actuator on its own
    "nothing_found": refuse(
        "nothing is known of {about} beyond the model: adopt or fit something first"
    ),
}

# a diagnosis: the gap between model and log, its causes, and the next trial
GAP: dict[str, Entry] = {
    # the three lines of a diagnosis
    "causes": note(
        "{causes}[[; and {more:smaller cause}]][[tied?; one of these ties with another "
        "cause]][[left?; a gap remains beside this]]",
    ),
    "none": note(
        "the model explains these trials[[known?  down to the noise]][[adopted?  as adopted]]"
    ),
    "unknown": note(
        "no known effect explains what the model leaves[[noise?, which may be noise]][[groups?  "
        "if both groups get the same values]]",
    ),
    "too_few": note("no cause can be named from these trials"),
    "refused": warn("the logs were refused: {why}"),
    "errors": note(
        "[[whole?over whole trials]][[{ahead:.3g} s ahead]] {who} misses {state} by {now:size}[[ "
        "instead of {before:size}]][[ (noise: {bound:yes=at most ,no=}{noise:size})]][[, {state2} "
        "by {now2:size}]][[ instead of {before2:size}]][[inside?, not held out]]",
    ),
    "left": note(
        "unexplained: [[{state} is off by {error:size} {ahead:.3g} s ahead]][[the rate of {rate} "
        "lacks something small but lasting]][[, {size} rms]][[ (noise: {bound:yes=at most "
        ",no=}{noise:size})]][[, mostly where {place}]][[, {part:%} of it in {trial} from "
        "{start:.3g} to {end:.3g} s]][[; {others:more state} {others:is/are} off]]",
    ),
    "where": note(
        "the gap is {share:%} in {state}[[ and {share2:%} in {state2}]][[, {part:%} of it where "
        "{place}]]",
    ),
    # what else is found
    "changed": warn(
        "[[{value} changed from {first} to {second} between the two groups of trials]][[!value? "
        "nothing changed between the two groups beyond the noise]]",
    ),
    "tie": warn(
        "these trials can't tell {effect} from {others}: each explains them",
        "[[own?adopting writes {effect}]]",
    ),
    "equivalent": note(
        "no log can tell {effect} from {others} in this model; plans are the same for all"
    ),
    "worse": warn(
        "predictions of {state} get worse [[{ahead:.3g} s ahead]][[whole? over whole trials]]: "
        "{now:size} instead of {before:size}",
    ),
    "disagree": warn(
        "the trials disagree on {quantity} of {effect}: {low} in {trial}, {high} in {trial2}"
    ),
    "one_motion": note("all trials repeat one motion: these values may not hold for another"),
    "unconfirmed": note(
        "unconfirmed: {effect} ({values}), which {seen} of {trials} trials show, all of one group"
    ),
    "small": note(
        "{state} is off by {error:size} [[{ahead:.3g} s ahead]][[whole?over whole trials]], "
        "{times:.2g} times the noise: too little to find a cause",
    ),
    "noise": note(
        "how much of the error of {state} is noise is not known", "repeat one run to know it"
    ),
    "correction": note(
        "a curve over {over} predicts {gain:%} of what no effect explains: no cause, but "
        "correction:{state} can be adopted",
    ),
    "more": note(
        "[[{most:cause} {most:is/are} named, as many as were looked for, and more is "
        "left]][[interrupted? interrupted while it looked for one more effect]]",
        "adopt these and diagnose again[[most?, or allow more with --max-effects]]",
    ),
    "sign": warn(
        "{input} acts the other way round",
        "flip its sign in model.py; if only the log has it so, multiply the scale in "
        f"[log.input.{{input}}] by -1 and ingest the logs again; {DIAGNOSE}",
    ),
    "corrected": warn("corrected here, but not in the stored trials: {about}", FIX),
    # the next step: one of them
    "next.record": note(
        "[[diagnose all: {stored:stored trial} of this task can be diagnosed as well]][[!stored? "
        "run another trial, or record a longer log, in which every input changes]]",
    ),
    "next.none": note("no trial is needed[[adopted?: nothing more is found]]"),
    "next.adopt": note(
        "no trial is needed: adopt the claimed causes[[left?; a diagnosis after it may tell more]]"
    ),
    "next.doubt": note(
        "adopt nothing yet: {why:worse=predictions get worse,little=predictions gain "
        "little,disagree=the trials disagree} with {about}",
        f"run another trial, {DIAGNOSE}",
    ),
    "next.changed": note(
        "the robot changed between the two groups: adopt no value of both",
        "diagnose the newer trials alone",
    ),
    "next.flip": note(f"flip the sign of {{input}}, {DIAGNOSE}"),
    "next.apart": note(
        "run a trial that may tell {effect} from {others}: small and large inputs of each sign",
    ),
    "next.confirm": note("run a trial of another motion or condition that shows {effect}"),
    "next.look": note(
        "look at the recording of {trial} from {start:.3g} to {end:.3g} s",
        "if the robot was held or pushed then, discard it and ingest its log without that part",
    ),
    "next.repeat": note(
        "[[run {candidate} twice more]][[log? record one run three times with the same inputs]], "
        "to see how much of the error of {state} is noise",
    ),
    "next.elsewhere": note(
        "run a trial[[ that spends more time where {place}]][[ with other steps and sweeps of "
        "{inputs}]], to see what {state} lacks",
    ),
    "next.fix": warn(FIX),
    "next.probe": note(
        "[[run {candidate}, ]]{probe}: expected to tell {effect} from {others} by {by:.3g} nats"
    ),
    "no_probe": note(
        "no probe[[ ({why})]][[!why?: none that was tried stays inside [safety] and near the "
        "trials]]",
    ),
    "next.no_probe": note(
        "no run inside the limits would tell {effect} from {others}",
        "[[claimed? adopt {claimed}]][[!claimed? record larger inputs or another manoeuvre]]",
    ),
}
