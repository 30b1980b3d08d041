"""What a report draws: figures of `grounded.figures`, from findings, before it is known how.

Read `runs.py` first (over time, and the list of all), then `paths.py` and `gap.py`; `png.py` makes
pictures of them.
"""
