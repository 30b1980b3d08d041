"""What the commands share: their options and their output.

Read `options.py` first.

options    `command`, which declares a command, and options that several have
terminal   output of text, tables, progress and JSON; the workspace of -C
"""
