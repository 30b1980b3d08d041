"""The figures of a report, as values of `grounded.figures` that page and pictures draw.

Read `runs.py` first (figures over time, and the list of all), then `paths.py`;
`png.py` draws figures with matplotlib.
"""
