"""Writes the workspace as a Rerun recording, one .rrd file. Only this package imports rerun.

Read `recording.py` first (the recorded entities), then `layout.py` (the views of the viewer).
"""
