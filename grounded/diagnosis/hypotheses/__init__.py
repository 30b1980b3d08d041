"""Which effect? Hypotheses are made, fitted and weighed against each other.

From the question to what remains:

    attribution   START HERE: the question, from the first look to the last candidate
    scan          a first look at every candidate effect
    explored      what was fitted, and what it is worth
    search        what to try next
    joint_model   all joints of an arm at once
    plainest      the plain dry friction of a joint, beside what has more numbers
    lookalike     what acts nearly the same on these data
    one_clock     late commands, or late sensors: one thing
    leftover      what no effect explains
    correction    a curve that predicts what no effect explains
"""
