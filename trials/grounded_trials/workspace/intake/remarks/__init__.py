"""Tell the user what to know about a trial before the next plan relies on it.

Read `gone_wrong.py` first, which asks whether the trial should be discarded, also in `status`.
`initial_state.py` warns of a start away from s_0, `log_faults.py` of columns in other units,
negated or exchanged.
"""
