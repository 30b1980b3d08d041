"""Foreign logs: what is in them, which signal is which state, their samples on the grid.

Read `log_table.py` first (the [log] table and how it is followed), then `signals.py`, `samples.py`
and `resample.py`. `inspect_*.py` look at an unknown log and guess its table; `recover.py` saves
what a damaged one still holds.
"""
