"""Ingest logs of the robot: a log becomes a stored trial of the candidate that it ran.

Read `ingest.py` first: the steps, what is stored, and the result. Each stands on those after it:

recognise   did it run its candidate? One case a log, its stories, the judge's choice, and how each
            is refused; by `look`: which candidate sent it, late or early starts, and falls
log_faults  columns of a stored trial that are in other units, negated or exchanged
gone_wrong  what else the user is told about it before the next plan relies on it; also by `status`
opening/    reading a file, a trial written by grounded or any other log through [log]; where in it
            the run begins

How a run's commands may have come about is one table, in `grounded.accounts.returned`.
"""

# faults that are mended in [log]
COLUMNS = (
    *("log.unit", "log.sign", "log.compass", "log.exchange", "log.dead"),
    *("log.offset", "log.axes", "log.pace", "log.clock"),
)
