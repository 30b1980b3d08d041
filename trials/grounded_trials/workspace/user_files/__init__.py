"""What the user wrote in a workspace: grounded.toml, model.py and target.csv.

Read `config.py` first (the tables of grounded.toml, checked key by key), then `model_file.py` (the
model) and `task_file.py` (the task, from the tables and the target).
"""
