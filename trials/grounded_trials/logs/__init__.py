"""Foreign logs: what is in them, which signal is which state, their samples on the grid.

Read `log_table.py` first (the [log] table and how it is followed), then `log_files.py` (which files
a log is), `signals.py`, `samples.py` and `resample.py`. `inspect_log.py` looks at an unknown log,
`twins.py` for signals of one motion in it, `inspect_guess.py` guesses its table,
`inspect_evidence.py` weighs the guesses by the log's own numbers, `inspect_pairs.py` positions by
their rates, `joint_names.py` by its joints;
`recover.py` saves what a damaged one still holds, which `salvage.py` finds.
"""
