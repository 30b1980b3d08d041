"""Diagnosis of the sim-to-real gap: where it is, which effects cause it, how far it can shrink.

Read `diagnose` first; its docstring lists the stages. `report` holds the result.

    likelihood/    likelihood of the trials under a hypothesis and its noise
    hypotheses/    search for the effects: hypotheses are made, fitted and compared
    validation/    held-out prediction errors in units, and the decision what is claimed
    writer         the result: facts, `remarks` and `next_step` as findings
    telling        what is told of it: lines, a table, findings and the next step
    excitation     the next trial, which would separate tied effects, from `patterns`
    tables         errors, compared effects and sensors in rows
    pictures       the result in figures
"""
