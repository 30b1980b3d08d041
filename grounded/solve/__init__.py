"""Optimal control in a model: the method A of the paper and the bias of its step 4.

Read `ddp.py` first (with its Riccati sweep), then `bias.py` (the model that replays a trial
exactly) and `policy_gradient.py`, the second A. `levenberg_marquardt.py` solves many small problems
at once.
"""
