"""Check whether a log is the run of its candidate, and if not, what it is instead.

Read `recognise.py` first: what is refused, with which remedy. `look.py` cuts the run from the log
and judges it by its commands; `sender.py` compares the candidates that may have sent them.
`read_otherwise.py` tries the log in other units, at another rate and with exchanged columns,
`misused_run.py` programs that passed their candidate the wrong things.
"""
