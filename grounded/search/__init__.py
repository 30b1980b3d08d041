"""The search on the REAL system, derived from stored trials: what to run next.

Read `improve.py` first: the paper's loop, one proposal at a time; `ask_tell.py` is the loop around
it. `making.py` makes a `candidate.py`; `limit_cycle.py` says whether feedback swung the inputs to
and fro, `margin.py` whether it holds with noise and on old samples; `mispredictions.py` corrects
the model's slopes by earlier trials, `corrected.py` is the model with them.
`standing.py` says where the search stands and why it ended, `certainty.py` how sure an improvement
is, `step_size.py` how far to go (damping, alpha), `first_policy.py` where it starts (DDP from many
runs, the first of them by `first_guess.py`), `planner.py` by which model it plans, `safety.py` what
may be handed out; `pictures.py` draws it.
"""
