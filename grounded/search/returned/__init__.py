"""Checks of a trial that came back: did its candidate drive it, and in the model's units?

whose_run    START HERE: whose run a trial is
who_drove    compares the logged commands with what the policy sends on these states
stories      what the log, or a program, must have been for other commands; all scored at once
clipped      finds commands that were cut inside their limits
smoothed     finds the filter of a program that logs its states as measured
told_trial   both checks as Python's `tell` and `learn` word them
"""
