"""The sim-to-real gap: where it lies, which effect makes it, how far it shrinks.

Read `diagnose` first; its docstring lists the stages. `report` is what comes out.

    likelihood/    how likely trials are under a hypothesis and its noise
    hypotheses/    which effect: made, fitted, weighed against each other
    validation/    what held-out predictions say of it, in units; what is claimed
    excitation     the trial that would tell what these data can't, one of `patterns`
    verdict        the result in words
    tables         in rows, for terminal, page and notebook
    pictures       the result in figures
"""
