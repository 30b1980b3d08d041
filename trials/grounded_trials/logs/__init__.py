"""Reading foreign logs: contents, assignment of signals to states and inputs, resampling.

Read `log_table.py` first (the [log] table and its use), then `log_paths.py` (the files of a log),
`log_files.py` (their records), `signals.py`, `samples.py`, `signal_report.py` and `resample.py`,
which finds by `command_steps.py` when commands changed. `stated_units.py` knows the units of a
log's numbers. `recover.py` saves the contents of a damaged log.

inspection/  unknown logs: what is in them, and which [log] table fits the model
"""
