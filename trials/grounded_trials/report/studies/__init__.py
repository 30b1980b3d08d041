"""Pictures of the paper's studies and of each effect's signature.

`trends.py` holds the table of studies; `bars.py` and `paths.py` draw the other kinds.
"""
