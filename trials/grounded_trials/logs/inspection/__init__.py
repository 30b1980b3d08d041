"""Look into an unknown log, and find which of its numbers are the model's states and inputs.

Read `inspect_log.py` first (what is in a log), then `assignment.py`: every number has points for
every state and input, the sum of named evidence, and the assignment of most points is taken. The
evidence is in `names.py` (words), `joint_names.py` (joints) and `relations.py` (what the samples
say). `guess.py` writes the [log] table.
"""
