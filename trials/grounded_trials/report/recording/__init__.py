"""The workspace as a Rerun recording, one .rrd file. Only this room imports rerun.

Read `recording.py` first (what is recorded, and how), then `layout.py` (the viewer's views).
"""
