"""report.html: one self-contained page.

Read `page.py` first, then `diagnosed.py`, its section on the diagnosis, and `tables.py`, its parts.
`page.html` is the template, `page.js` draws the figures with Plotly.
"""
