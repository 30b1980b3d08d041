"""The search on the REAL system, derived from stored trials: what to run next.

Read `improve.py` first: the paper's loop, one proposal at a time. `standing.py` says where the
search stands, `step_size.py` how far to go (alpha, damping), `first_policy.py` where it starts,
`planner.py` by which model it plans; `certainty.py` and `safety.py` say what may be believed and
what may be handed out.
"""
