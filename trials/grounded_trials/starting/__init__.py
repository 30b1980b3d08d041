"""From a log to a workspace: what the log is, a model to begin with, a manoeuvre to follow.

Read `begin.py` first: it makes the folder. `kinds.py` has a model skeleton for each kind of robot
and tells the kind from a log; `shapes.py` draws targets: lines, circles, figure-8s, steps,
swing-ups, or a run that was recorded. `blank.py` makes a workspace of a model alone, without a log.
"""
