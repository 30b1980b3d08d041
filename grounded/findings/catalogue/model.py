"""Findings on the model: what the data can't tell of it, its parameters, its adopted effects."""

from __future__ import annotations

from grounded.findings.catalogue import Entry

ENTRIES: dict[str, Entry] = {
    # what the trials can't show
    "few": Entry(
        "warn",
        "[[{steps:step} in all are]][[!steps? one trial alone is]] too few to tell an effect from "
        "noise",
        "record {needed:step} or more[[!steps? , or a second trial]]",
    ),
    "still": Entry(
        "warn", "{about} never changed, so effects on {about:it/them} can't be identified"
    ),
    "unmeasured": Entry("note", "{about} {about:was/were} never measured"),
    "share": Entry(
        "note",
        "of {total:,} [[stretches? stretches]][[!stretches? steps]] {used:,} were used"
        "[[, in {kept} of {trials} trials]][[first?, the first of each]]"
        "[[stretches?, those with most motion]]",
    ),
    "copy": Entry("warn", "{about} equals {first}: a copy, or no noise at all; it counts once"),
    # its parameters
    "off": Entry("note", "[[{values}]][[!values?{names} {names:is/are} off]]"),
    "given": Entry(
        "note",
        "{about} {about:is/are} known only [[if {rests} {rests:is/are} right as declared]]"
        "[[!rests? together with the others]]",
    ),
    "not_told": Entry(
        "note",
        "the trials do not tell {about}, which {about:stays/stay} as {about:it was/they were}"
        "[[, {kept}; the effects were fitted with {value}]]",
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
    "sensor": Entry(
        "note",
        "[[a gear between {rate} and it]][[!rate? a mount out of level]] would look the same in "
        "any log as the error of the sensor of {about}",
        "measure it before you correct the sensor",
    ),
    # a fit
    "fitted": Entry(
        "note",
        "[[{settled:yes=converged,no=still rising}, from {samples:sample}]]"
        "[[no_better? ; the values before are as likely, or predict held-out trials as well]]",
    ),
    "fit_worse": Entry(
        "refuse",
        "the fitted values predict held-out trials worse ({state} {ahead:.3g} s ahead: "
        "{now:size} instead of {before:size}); they make up for something that the model lacks",
    ),
    "times": Entry(
        "note",
        "[[{about} kept {about:its/their} d, which the intervals take as exact]][[!about? times "
        "are "
        "known to]][[ {rows:.3g} s between rows of the log]][[ {early:.2g} s by the interpolation "
        "of states]][[!about?  at best, which is in their intervals]]",
    ),
    # an adoption
    "adopted": Entry("note", "adopted: {about}"),
    "readings": Entry(
        "note",
        "targets and distances of {about} are in readings of its sensor[[, {bias} too {way}]]"
        "[[, {by:%} too {way}]][[, {age} old]]",
        "for true values correct the log ([[offset {offset:+.3g}]][[!offset? scale or delay_s]] in "
        "[log.state]) and the robot's program, and remove the effect",
    ),
    # taken home
    "no_place": Entry(
        "warn",
        "{about}[[ = {value}]] has no place in the file[[: {equation}, with {values}]]",
        "add it to the program that [[values? steps]][[!values? loads]] the model",
    ),
    "reads": Entry("note", "the file reads {about}", "put {about:it/them} beside it"),
    "other_form": Entry(
        "refuse",
        "{about} can't be written: the model comes from [[{source}, which stays as it is]]"
        "[[!source? no file of its own]]",
        "name another file with the ending of an MJCF, URDF or Python file that model.py names",
    ),
    # what can't be adopted, or undone
    "not_adoptable": Entry(
        "refuse",
        "{about} can't be adopted: {why:adopted=it stands in [model] effects already,rival=it "
        "was fitted instead of what is claimed, not with it,worse=it does not predict trials "
        "better that it was not fitted to,together=it was fitted together with,unvalued=the "
        "diagnosis lacks its value}[[ {effect}]]",
        "{why:rival=adopt the claimed, or one alone,worse=run more trials and diagnose again,"
        "together=adopt them together}",
    ),
    "edited": Entry(
        "refuse",
        "[[[model] in {about} was changed after {adopted} was adopted, which undoing would lose]]"
        "[[!adopted? no adoption is left to undo]]",
        "edit it by hand[[; before the adoption it had {had}]][[; it has {effects}]]",
    ),
    # its file
    "fails": Entry(
        "refuse",
        "{about}[[ line {line}]]: {why}",
        "[[called? it is called with states, inputs and parameters: (s, a, p)]]",
    ),
    "not_finite": Entry(
        "refuse",
        "the predictions of {about} are not finite[[: {trial}, t = {at}, {values}]]",
        "[[!at? fit its parameters, or check their units]][[at? noise can carry a logged value "
        "outside the domain of a square root or a logarithm: bound the argument in the model "
        "(np.maximum(x, 0))]]",
    ),
    "differs": Entry(
        "refuse",
        "{about}: the [[!by? trace]][[by? jacobian]] of '{state}' differs from the function"
        "[[, {ours} and {own}]][[ by '{by}', by {off:.3g}]]",
        "[[by? leave jacobian out to difference the step]][[!by? does it use random numbers, keep "
        "a "
        "memory, or look at the type of its arguments?]]",
    ),
    "undefined": Entry(
        "refuse",
        "{about} does not define `model = Model(...)`",
        "[[rename '{other}' to 'model']][[!other? see the README for an example]]",
    ),
    "name_only": Entry(
        "refuse",
        "{about}: '{name}' names one of the {what}s, which can't be assigned to",
        "use a local variable",
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
    # an actuator on its own
    "nothing_found": Entry(
        "refuse", "nothing is known of {about} beyond the model: adopt or fit something first"
    ),
}
