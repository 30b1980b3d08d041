"""Diagnosis of the sim-to-real gap: where it is, which effects cause it, how far it can shrink.

Read `diagnose` first; its docstring lists the stages. `report` holds the result.

    likelihood/    likelihood of the trials under a hypothesis and its noise
    hypotheses/    search for the effects: hypotheses are made, fitted and compared
    validation/    held-out prediction errors in units, and the decision what is claimed
    excitation     the next trial, which would separate tied effects, from `patterns`
    verdict        the result in words; `next_trial` says what to run next
    tables         the result in rows, for terminal, page and notebook
    pictures       the result in figures
"""
