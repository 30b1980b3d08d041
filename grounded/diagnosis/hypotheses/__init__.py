"""Search for the effects that explain the gap: hypotheses are made, fitted and compared.

The modules:

    attribution   START HERE: the whole search, from the first scan to the last effect added
    scan          linear estimate of what every candidate effect would gain, at `grid_points`
    explored      the hypotheses fitted so far, and their evidence
    search        the fits to try next
    swaps         other effects in place of those of a set
    orders        other orders in which effects act on a command
    tuning        the constants of effects, which are no parameters of a fit
    joint_model   friction and inertia of all joints of an arm at once
    plainest      plain dry friction of a joint, as a rival of effects with more parameters
    lookalike     effects whose signals are nearly the same in these data
    stand_in      look-alikes fitted in place of an effect, with the parameters free
    one_clock     delayed commands and delayed sensors, which are equivalent
    leftover      structure that no effect explains
    correction    a curve that predicts the leftover
"""
