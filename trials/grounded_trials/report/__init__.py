"""What a workspace shows of itself: text, page, pictures, recording.

Read `findings.py` first (all that is shown, as values) and `gathering.py` (how it is read);
`forecast.py` is how well the model predicts, `scene.py` where a body is in space,
`diagnosis_words.py` the diagnosis in sentences. `report_text.py` is the report for a terminal;
`figures/` says what is drawn (as values of `grounded.figures`), `page/` and `recording/` lay it out
for a browser and for Rerun, `studies/` draws the paper's studies; `reporting.py` writes the files.
"""
