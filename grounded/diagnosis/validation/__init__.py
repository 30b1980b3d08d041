"""Validation on held-out trials: which of the likely effects are claimed, and how certain they are.

Read `ruler`, then `decide`. The modules, from the measurement to the claims:

    limits      the data, and what they can't determine
    ruler       held-out open-loop errors over 0.1, 0.5, 1 s and whole trials, in units
    choose      the rule: the smallest set of causes that predicts as well as any
    decide      the fitted hypotheses as options of the rule, and its guards
    measured    errors, noise floor, credit and leftover of a decision, and where the gap is
    certainty   intervals averaged over models and by priors, and which parameters are off
    claims      the claimed effects with intervals, their rivals and look-alikes
    agreement   whether the trials agree; changes between two groups of trials
"""
