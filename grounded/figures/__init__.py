"""What is drawn, as plain values: page, pictures, recording and notebook show the same figures.

Read `figure.py` first (the values), then `interactive.py` (the same for Plotly).
"""
