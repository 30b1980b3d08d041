"""The search on the REAL system: choose what to run next from the stored trials.

Read `improve.py` first: it makes one proposal of the paper's loop.

ask_tell        the loop around the proposals
standing        the state of the search, and why it ended
certainty       how certain an improvement is, from `scatter`, the noise of utilities
first_policy    the first policy: DDP from many starts, the first of them from `first_guess`
step_size       damping and alpha of the next step, and the settings of a search
directions      the direction of the step, by DDP or policy gradient
making          builds a `candidate`
limit_cycle     detects feedback that makes the inputs oscillate
quiet_gains     bounds gains by what ran without oscillating
margin          checks gains under noise and with old samples
mispredictions  corrects the model's derivatives from earlier trials (`corrected`), and compares
                gains in several models that explain the trials
by_step         corrects the derivatives of each step of the run by themselves, after two losses
original        steps with the model as it was, if adopted effects broke their promises
planner         the model used for planning, with adopted effects
safety          checks a candidate before it is handed out
who_drove       checks by a trial's commands whether it ran its candidate, `other_scale` whether it
                did with a column multiplied; `told_trial` does so for trials told in Python
pictures        figures of the search
returned/       checks of a trial that came back
"""
