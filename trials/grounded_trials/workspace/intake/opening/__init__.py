"""Open a file that is to be ingested, before it is checked what it ran.

Read `reading.py` first: a trial written by grounded must belong to this workspace. Any other log is
read by `foreign.py` through [log]; `estimating.py` finds its unmeasured states, `stored_before.py`
whether a log is stored already, and `run_start.py` where a candidate's run begins in a log, on the
samples that the robot's program had when it sent a command.
"""
