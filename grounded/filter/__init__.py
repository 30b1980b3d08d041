"""One Kalman filter and smoother, for `estimate`, `fit` and `diagnosis`.

    kalman      gains, innovations of any number of columns, smoother; START HERE
    kernels     the same three passes as machine code
    augmented   states that a filter carries beside the model's: coloured noise, delayed channels

Nothing here knows a model or a trial: a linear system goes in, arrays come out. Who linearises,
and about what, is the caller's: `grounded.estimate` (the extended Kalman filter),
`grounded.diagnosis.likelihood.linearise` (a hypothesis along its own track).
"""
