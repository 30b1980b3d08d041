"""Reading foreign logs: contents, assignment of signals to states and inputs, resampling.

Read `log_table.py` first (the [log] table and its use), then `log_files.py` (the files of a log),
`signals.py`, `samples.py`, `signal_report.py` and `resample.py`. `inspect_log.py` summarises an
unknown log, `twins.py` finds redundant signals in it, and `inspect_guess.py` guesses its [log]
table, which `guessed_table.py` writes. `inspect_evidence.py` checks the guesses against the
samples, `inspect_pairs.py` positions against rates, `joint_names.py` the names of joints.
`recover.py` saves the contents of a damaged log, which `salvage.py` finds.
"""
