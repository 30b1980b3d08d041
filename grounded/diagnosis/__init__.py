"""The sim-to-real gap: where it lies, which effect makes it, how far it shrinks.

Read `diagnose` first; its docstring lists the stages. `report` is what comes out, `attribution`
the question "which effect?". Below them lie, from the data upwards
(the Kalman filter is `grounded.filter`):

    data                  trials as one record, cut into runs of equal length
    hypothesis            effects with their values, and what they predict
    delays                a sensor that shows an earlier state
    noise                 the noise, estimated beside everything else
    linearise             a hypothesis to first order: the columns that are filtered
    refine, fitted        many hypotheses up their likelihood at once; where each ends
    scan                  a first look at every candidate effect
    hypotheses, search    what was fitted, what it is worth, what to try next
    held_out, claims      the gap and utilities on other trials; what is claimed, with intervals
    lookalike, leftover   what acts nearly the same; what no effect explains
    ruler, decide, measured     held-out errors in units; they decide; what they say of the decision
    correction            a curve that predicts what no effect explains
    agreement             whether the trials agree; what changed between two groups
    prediction_error, split     where the gap lies, and what the error is made of
    limits, excitation    what the data can't tell; the trial that would
    verdict, pictures     the same in words; in figures
"""
