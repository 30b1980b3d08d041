"""A user's function, run once on expressions: the graph of what it computed, and its derivatives.

Read `tracing.py` first, then `expression.py` and `functions.py` (what the function sees and calls),
`graph.py` (what is kept), `derivative.py` (its derivatives).
"""
