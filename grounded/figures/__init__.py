"""Figures as plain values, shared by the page, pictures, recordings and notebooks.

Read `figure.py` first (the values, and a robot as a stick figure), then `interactive.py` (their
Plotly form).
"""
