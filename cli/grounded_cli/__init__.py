"""The commands of `grounded`: options, one call of `grounded_trials.Workspace`, a printout.

Read `main.py` first: the list of commands with the file of each, and how errors become exit codes.
`options.py` has what commands share, `terminal.py` how words, tables and progress are shown,
`completion.py` the TAB key. `studies/` has the commands that need no robot.
"""
