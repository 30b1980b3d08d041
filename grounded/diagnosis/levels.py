"""The levels that a diagnosis decides by, wherever it does: one for each question.

docs/diagnosis-method.md has the curves of NATS, SURE, SHARE and LEAST over blind cases, which
`benchmarks/decide.py --curves` draws again; each other level stands in the section named beside it.
"""

from __future__ import annotations

# evidence [nats]
NATS = 3.0  # from which one explanation is preferred; within it two tie ("Decide")
PICKED = 8.0  # of what was picked among many: a cause, a leftover, a changed value ("Decide")

# standard errors, and chance
ERRORS = 0.9  # by which one prediction is better than another ("Decide")
SURE = 2.0  # from which a value differs from zero, or a prediction is clearly better ("Decide")
MANY = 3.0  # the same for the most striking of many: channels, trials, regions ("Leftover")
CHANCE = 1e-3  # p-value below which trials disagree, or noise is not white ("Values")

# prediction errors, and what relates to them
SHARE = 0.02  # of a whole, such as what a set gains, below which a part is none ("Decide")
LEAST = 0.01  # change of a logarithm below which a difference does not matter ("Decide")
SHOWS = 0.1  # relative change, or share of a gap, below which nothing is told ("Leftover")
ABOVE = 1.3  # times the noise floor, above which something is left ("Leftover")
FAR = 3.0  # times the noise, or the usual: something is left beyond doubt, or there ("Leftover")
WILD = 10.0  # times what others miss, or what was measured: no repeat, no prediction ("Leftover")

# shares
HALF = 0.5  # of a whole, from which a part is most of it ("Leftover")
ALIKE = 0.2  # relative difference of numbers that may be one, of lengths of repeats ("Values")
WELL = 0.02  # +- relative to a value, below which it is well known ("Values")
ROUNDING = 1e-9  # relative difference that is none
