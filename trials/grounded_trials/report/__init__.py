"""Reports of a workspace: text, page, pictures, recording.

Read `findings.py` first (all contents of a report, as values) and `gathering.py` (how they are
read). `forecast.py` has predictions along a trial and their figures, `bodies.py` places a robot in
space, and `tables.py` has the sentences and tables of terminal, page and recording. `figures/`
makes the other figures (values of `grounded.figures`). `page/` and `recording.py` lay them out for
a browser and Rerun, the command `report` for a terminal; `reporting.py` writes the files.
"""
