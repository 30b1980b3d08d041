"""Likelihood of the trials under a hypothesis: the model, effects with their values, and noise.

Read `hypothesis`, then `refine`. The modules, each building on those above it (the Kalman filter
itself is `grounded.filter`):

    levels        what is asked of evidence and of a standard error
    groups        trials that make the same motion under the same condition
    data          all trials as one record, cut into runs of equal length
    hypothesis    effects with their values, and shifts of the model's parameters
    predictor     what a hypothesis predicts
    simulated     cached slopes of a simulator; tangent: steps nearby from these slopes
    delays        sensors that show earlier states
    noise         variances of process and measurement noise, estimated with everything else
    linearise     linearisation about a track: the columns that are filtered
    step          the next step of the fit: Gauss-Newton and scoring
    refine        maximum likelihood of many hypotheses at once
    fitted        the result of a fit
    polish        convergence of the fits that decide
"""
