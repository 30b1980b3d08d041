"""Evidence proposes, held-out predictions decide: what is claimed, in units, and how sure.

Read from the measurement to what is said of it:

    ruler              held-out open-loop errors over 0.1, 0.5, 1 s and whole runs, in units
    gain               what one hypothesis predicts better than another
    visits             where an effect acts, and whether few trials show it
    motions            in how many motions that differ an effect is seen
    decide             the ruler's decision on what the evidence proposes
    measured           what a decision is said to be worth
    held_out           the gap and utilities on other trials
    prediction_error   where the gap lies
    split              what the error is made of
    claims             what is claimed, with intervals
    limits             what the data can't tell
    agreement          whether the trials agree; what changed between two groups
"""
