"""Look into an unknown log, and guess which of its numbers are the model's states and inputs.

Read `inspect_log.py` first (what is in a log), then `inspect_guess.py` (guesses by name) and
`inspect_evidence.py` (guesses checked against the samples). That uses `inspect_pairs.py` (rates
follow positions), `inspect_groups.py` and `inspect_steps.py` (the model's steps decide) and
`joint_names.py`. `guessed_table.py` writes the [log] table.
"""
