"""report.html: one self-contained page.

Read `page.py` first, then `diagnosed.py`, its section on the diagnosis, and `tables.py`, its parts.
`page.html` is the template, `page.js` draws the figures with Plotly.
`plotly-basic.min.js` is Plotly's own smallest bundle, unchanged (npm: plotly.js-basic-dist-min
4.1.1, MIT): a quarter of the one that the Python package brings; a page opens in half a second.
"""
