"""Find a candidate's run in a log: where it begins, and where it failed although the log goes on.

Read `run_start.py` first: the commands of the log are compared with the policy's, from every
instant on. `acted_on.py` finds which samples the robot's program had when it sent a command, and
`fell.py` falls.
"""
