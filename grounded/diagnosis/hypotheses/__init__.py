"""Search for the effects that explain the gap: hypotheses are made, fitted and compared.

The modules:

    attribution   START HERE: the whole search, from the first scan to the last effect added
    scan          linear estimate of what every candidate effect would gain
    explored      the hypotheses fitted so far, and their evidence
    search        the fits to try next
    variations    other terms for a set: other effects, inputs, constants, plain friction
    joint_model   friction and inertia of all joints of an arm at once
    lookalike     effects that these trials, or no trials, tell from a claimed one
    leftover      structure that no effect explains, and a curve that predicts it
"""
