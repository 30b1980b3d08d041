"""Draws pictures of the paper's studies and of each effect's signature.

Read `pictures.py` first: it holds the table of studies and draws curves; `bars.py` draws bars,
`effect_pictures.py` the signatures in docs/effects.md.
"""
