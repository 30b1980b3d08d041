"""The search on the REAL system: choose what to run next from the stored trials.

Read `improve.py` first: it makes one proposal of the paper's loop.

ask_tell      the loop around the proposals
standing      the state of the search, and why it ended
difference    is one candidate better than another, by how much, how sure; which improved
noise         of the sensors, and what it costs
first_policy  the first policy: DDP from many starts, the first of them from `first_guess`
making        builds a `candidate`: from a step, gentler gains, or the plan of a changed model
planner       the model used for planning, with adopted effects
design        the next trial for a diagnosis: a drive that tells values, a probe of a tie
safety        checks a candidate before it is handed out
pictures      figures of the search
step_size     damping and alpha of the next step, and the settings of a search
mispredictions  derivatives corrected from earlier trials; `corrected`: the model with them
feedback      gains that a real robot bears: oscillation, noise, old samples
"""
