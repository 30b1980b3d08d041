"""What the commands share: their options and their output.

Read `options.py` first.

options    `command`, which declares a command, and options that several have
workspace  the folder of the option -C, and the next command to type for it
terminal   output of text, tables, progress and JSON
"""
