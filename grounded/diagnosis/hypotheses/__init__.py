"""Search for the effects that explain the gap: hypotheses are made, fitted and compared.

The modules:

    attribution   START HERE: the whole search, from the first scan to the last effect added
    scan          linear estimate of what every candidate effect would gain
    explored      the hypotheses fitted so far, and their evidence
    search        the fits to try next
    variations    other terms for a set: other effects, fewer inputs, plain friction, other orders
    orders        other orders in which effects act on a command
    tuning        the constants of effects, which are no parameters of a fit
    joint_model   friction and inertia of all joints of an arm at once
    lookalike     effects that these trials, or no trials, tell from a claimed one
    leftover      structure that no effect explains
    correction    a curve that predicts the leftover
"""
