"""Validation on held-out trials: which of the likely effects are claimed, and how certain they are.

Read `ruler`, then `decide`. The modules, from the measurement to the claims:

    ruler              held-out open-loop errors over 0.1, 0.5, 1 s and whole trials, in units
    ahead              the open-loop predictions themselves
    gain               improvement of one hypothesis over another, and its scatter
    choose             the rule: the smallest set of causes that predicts as well as any
    decide             the fitted hypotheses as options of the rule, and its guards
    acting             where an effect acts
    measured           errors, noise floor, credit and leftover of a decision
    held_out           the noise-normalised gap and utilities, held out
    prediction_error   where the gap is, by channel, time and region
    blame              which of the model's own parameters are off
    claims             the claimed effects with intervals, their rivals and look-alikes
    averaged           intervals averaged over models
    by_priors          values that only priors set, since the data show combinations
    limits             what the data can't determine
    agreement          whether the trials agree; changes between two groups of trials
"""
