"""How a workspace is made: of a log, of a model alone, of an example; and a manoeuvre to follow.

Read `begin.py` first: it makes the folder. `kinds.py` has a model skeleton for each kind of robot
and tells the kind from a log; `shapes.py` draws targets: lines, circles, figure-8s, steps,
swing-ups, or a run that was recorded. `blank.py` makes a workspace of a model alone,
`examples.py` those that come with grounded, and it writes every grounded.toml.
"""
