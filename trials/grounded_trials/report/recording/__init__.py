"""The workspace as a Rerun recording, one .rrd file. Only this room imports rerun.

Read `recording.py` first, then `layout.py` (the views) and `marks.py` (curves, paths and bodies).
"""
