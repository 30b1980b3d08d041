"""Pictures of the paper's studies and of each effect's signature.

`pictures.py` holds the table of studies and draws curves, `bars.py` draws bars.
"""
