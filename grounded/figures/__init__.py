"""Figures as plain values, shared by the page, pictures, recordings and notebooks.

Read `figure.py` first (the values), then `interactive.py` (their Plotly form); `body.py` has the
moving bodies.
"""
