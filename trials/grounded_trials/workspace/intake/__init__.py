"""Ingest logs of the robot: a log becomes a stored trial of the candidate that it ran.

Read `ingest.py` first: what is refused and what is stored; `ingested.py` is its result.
`reading.py` opens the file: a trial written by grounded must belong to this workspace; any other
log is read by `foreign.py` through [log], and its unmeasured states are found by `estimating.py`.
`run_start.py` finds where the run begins in a log (with `instants.py`), and `fell.py` where it
failed although the log goes on; `look.py` decides with them which part of the log is judged.
`grounded.search.returned.who_drove` checks whether it ran the candidate at all, `acted_on.py`
whether it ran an older one, `grounded.search.returned.other_scale` whether it did with a column
multiplied, `crossed.py` whether signals are read from each other's columns, `log_faults.py` whether
columns are in other units, negated or exchanged, `misused_run.py` whether the robot's program
passed its candidate the wrong things, and `skipped_steps.py` whether it ran all of its steps.
`gone_wrong.py` asks whether a run went as it should, `ended_early.py` whether it crashed or was cut
off, and `unanswered.py` repeats in `status` what they ask. `odd_run.py` reports what a run that
does not belong did to its candidate, `trial_check.py` what the user should know about a trial,
`where_to_mend.py` which key of [log] corrects a sensor fault, `handed_over.py` what it costs that
samples were old when the program acted on them, and `stored_before.py` whether a log is stored
already.
"""
