"""report.html: one self-contained page.

Read `page.py` first; the other two are its section on the diagnosis and its tables.
"""
