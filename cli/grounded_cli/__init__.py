"""The commands of `grounded`, one a file, named after it.

Read `main.py` first (the list of commands, and how errors become exit codes), then any command:
options, one call of `grounded_trials.Workspace`, a printout and `--json`. `options.py` has what
commands share, `terminal.py` how words, tables and progress are shown, `completion.py` the TAB key.
"""
