"""The commands of `grounded`: each parses its options, calls `grounded_trials.Workspace`, prints.

Read `main.py` first: it lists the commands with their files and turns errors into exit codes.
`options.py` has the options that commands share, `terminal.py` the output of text, tables and
progress, `completion.py` shell completion. `studies/` has the commands that need no robot.
"""
