"""Reports of a workspace: text, page, pictures, recording.

Read `findings.py` first (all contents of a report, as values) and `gathering.py` (how they are
read). `forecast.py` computes prediction errors, `scene.py` places a body in space and
`report_text.py` is the report for a terminal;
`figures/` makes the figures (values of `grounded.figures`), `page/` and `recording/` lay them out
for a browser and for Rerun, `studies/` draws the paper's studies; `reporting.py` writes the files.
"""
