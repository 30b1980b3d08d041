"""The commands of `grounded`: each parses its options, calls `grounded_trials.Workspace`, prints.

Read `commands.py` first: it declares every command; what one does is in the module of its name.
`main.py` turns errors into exit codes, `console/` has what commands share.
"""
