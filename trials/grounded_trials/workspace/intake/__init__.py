"""Ingest logs of the robot: a log becomes a stored trial of the candidate that it ran.

Read `ingest.py` first: the steps, what is stored, and the result. Each room below stands on those
after it:

recognising/  did it run its candidate? What is refused, and what it is instead
remarks/      what the user is told about a trial that is stored
opening/      reading a file, a trial written by grounded or any other log through [log]; where in
              it the run begins

How a run's commands may have come about is one table, in `grounded.accounts.returned`.
"""
