"""A workspace, a folder with a task, its trials and candidates; what each command does in it.

Read `folder.py` first (how a folder becomes a task, trials and candidates). `config.py`,
`task_file.py` and `model_file.py` read what the user wrote. A verb each: `proposing.py` (status
too), `running.py`, `intake/` (what came back from the robot), `looping.py`, `fitting.py`,
`diagnosing.py`, `adopting.py`, `exporting.py`, `inspecting.py`, `verifying.py`;
`grounded_trials.door` makes them the methods of one class. `identity.py` says what a name stands
for, `handover.py` what a candidate must be when it leaves, `next_step.py` what a person does next.
Of single use: `first_plan.py` for `propose`, `adopted.py` for planning with adopted effects.
"""
