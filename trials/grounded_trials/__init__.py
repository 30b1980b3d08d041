"""The disk: logs, the store, the workspace, reports. A file is data, never code.

formats/    bytes of log files as arrays
logs/       foreign logs: which signal is which state, samples on the control grid
store/      our own files, content-addressed
workspace/  START HERE: a folder with a task, and what each command does in it
report/     text, page, pictures, recording
"""
