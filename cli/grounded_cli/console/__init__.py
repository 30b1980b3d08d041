"""What the commands share: their options, their output, and the shell's completion.

workspace_option  START HERE: the option -C, and the next command to type for its workspace
options           the other options that several commands have
terminal          output of text, tables, progress and JSON
completion        completes candidates, trials and effects; the command that installs it
"""
