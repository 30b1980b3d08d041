"""A workspace (a folder with a task, its trials and candidates) and what each command does in it.

Read `folder.py` first (how a folder becomes a task, trials and candidates). `config.py`,
`task_file.py` and `model_file.py` read what the user wrote. One module per verb: `proposing.py`
(also status), `running.py`, `intake/` (ingesting logs), `looping.py`, `fitting.py`,
`diagnosing.py`, `adopting.py`, `exporting.py`, `inspecting.py`, `verifying.py`;
`grounded_trials.door` makes them the methods of one class. `identity.py` resolves the names of
trials and candidates, `handover.py` checks candidates before they are handed over, `next_step.py`
chooses the command to suggest next, after what `last_diagnosis.py` reads. `first_plan.py` and
`at_rest.py` serve the first `propose`, with `wrong_units.py`; `adopted.py` plans with adopted
effects.
"""
