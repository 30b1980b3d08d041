"""What came back from the robot: a log becomes a stored trial of the candidate that it ran.

Read `ingest.py` first: what is refused, what is stored, what `ingested.py` says of it. `reading.py`
opens the file: a trial of ours must be of this workspace; a log that grounded did not write is read
by `foreign.py` through [log], its unmeasured states by `estimating.py`. `run_start.py` says where
in it the run begins (by `instants.py`), `fell.py` where it failed though the log goes on,
`who_drove.py` whether it ran the candidate at all, `acted_on.py` whether an older one,
`other_scale.py` whether it did with a column multiplied, `crossed.py` whether signals are read from
each other's column, `log_faults.py` whether columns are in other units, turned or exchanged,
`odd_run.py` what a run that does not belong did to its candidate, `trial_check.py` what a person
should know before believing it, `where_to_mend.py` which table of
[log] a sensor's fault is put right in, `stored_before.py` whether it is here already.
"""
