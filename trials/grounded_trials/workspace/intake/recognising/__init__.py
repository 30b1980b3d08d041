"""Check whether a log is the run of its candidate, and if not, what it is instead.

Read `recognise.py` first: one case a log, its stories, the judge's choice, and how each is refused.
`grounded.accounts.returned` has the terms by which all are scored. `look.py` finds which candidate
sent the commands of a log, late or early starts, and falls.
"""
