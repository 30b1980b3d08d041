"""The search on the REAL system, derived from stored trials: what to run next.

Read `improve.py` first: the paper's loop, one proposal at a time; `ask_tell.py` is the loop around
it. `standing.py` says where the search stands and how sure an improvement is, `step_size.py` how
far to go (alpha, damping), `first_policy.py` where it starts, `planner.py` by which model it plans,
`safety.py` what may be handed out.
"""
