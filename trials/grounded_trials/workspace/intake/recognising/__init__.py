"""Check whether a log is the run of its candidate, and if not, what it is instead.

Read `recognise.py` first: the stories of a log, the judge's choice, and how each is refused.
`grounded.accounts.returned` has the terms by which all are scored. `look.py` cuts the run from the
log, judges which candidate sent its commands, and finds falls.
"""
