"""A workspace (a folder with a task, its trials and candidates) and what each command does in it.

Read `folder.py` first: how a folder becomes a task, trials and candidates. `identity.py` identifies
policies by their bytes, and explains names that don't exist.

user_files/  what the user wrote: grounded.toml, model.py, target.csv
candidates/  planning the next candidate, handing it over, running it: propose, export, run
intake/      logs become stored trials: ingest

One module per further verb: `new_target.py`, `inspecting.py`, `looping.py` (learn and next),
`fitting.py`, `diagnosing.py`, `adoption.py`, `discarding.py`, `verifying.py`;
`grounded_trials.door` makes them the methods of one class. `next_step.py` chooses the command to
suggest next, after what `last_diagnosis.py` reads. `adopted.py` plans with adopted effects,
`where_to_mend.py` says how [log] read the trials and where to correct a finding about a sensor, and
`off_target.py` measures errors of a run in units.
"""
