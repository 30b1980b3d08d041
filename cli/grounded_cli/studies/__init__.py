"""The commands that need no robot and no workspace: a demo, the paper's studies, blind cases.

Read `demo.py` first.
"""
