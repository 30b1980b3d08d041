"""A user's function, run once on expressions: the graph of what it computed, and its derivatives.

Read `tracing.py` first, then `expression.py` (what the function sees), `functions.py` and
`rebinding.py` (NumPy and Python made traceable), `graph.py` and `operations.py` (what is kept),
`derivative.py`.
"""
