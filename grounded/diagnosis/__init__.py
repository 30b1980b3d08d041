"""Diagnosis of the sim-to-real gap: where it is, which effects cause it, how far it can shrink.

Read `diagnose` first; its docstring lists the stages. `parts` holds the result.

    likelihood/    likelihood of the trials under a hypothesis and its noise
    hypotheses/    search for the effects: they are made, fitted and compared
    validation/    held-out prediction errors in units, and the decision what is claimed
    writer         the result: facts, and its findings with the next step
    telling        what is told of it: lines, tables, findings, figures
"""
