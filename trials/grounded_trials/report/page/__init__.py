"""report.html: one self-contained page.

Read `page.py` first; its sections are those of `report.tables`.
`page.html` is the template, `page.js` draws the figures with Plotly.
`plotly-basic.min.js` is Plotly's smallest bundle, unchanged (npm: plotly.js-basic-dist-min 4.1.1,
MIT). It is a quarter of the size of the bundle in the Python package, so that pages open fast.
"""
