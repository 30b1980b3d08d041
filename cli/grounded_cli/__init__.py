"""The commands of `grounded`: each parses its options, calls `grounded_trials.Workspace`, prints.

Read `main.py` first: it lists the commands with their files and turns errors into exit codes.
`console/` has what they share: options, output of text, tables and progress, shell completion.
"""
