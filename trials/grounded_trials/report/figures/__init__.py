"""What is drawn, before it is known how: the page and the pictures show the same figures.

Read `figure.py` first (the plain values), then `runs.py`, `utilities.py` and `gap.py` (what they
show); `axis.py`, `draw.py` and `png.py` turn them into shapes and files.
"""
