"""The next step from the best policy: how far, in which direction, by which derivatives.

step_size       START HERE: damping and alpha of the next step, and the settings of a search
directions      step 5 of the paper: the direction, by DDP or policy gradient
mispredictions  the model's derivatives, corrected from the mispredictions of earlier trials
corrected       the model with such derivatives, to plan and simulate in
"""
