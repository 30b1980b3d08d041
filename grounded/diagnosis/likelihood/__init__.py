"""How likely trials are under a hypothesis: model, effects with their values, and noise.

Read from the data upwards (the Kalman filter itself is `grounded.filter`):

    data          trials as one record, cut into runs of equal length
    hypothesis    effects with their values, and what they predict
    simulated     what a simulator was asked already; tangent: steps from close by
    delays        a sensor that shows earlier states
    noise         the noise, estimated beside everything else
    linearise     a hypothesis to first order: the columns that are filtered
    step          the step that is proposed at the best point
    refine        many hypotheses up their likelihood at once
    fitted        where each ended
"""
