"""The numbers by which accounts are judged: each stands for one idea, wherever it is asked."""

# relative differences: a number's resolution, none, hardly any, small, and still explained
FINE, EXACT, SLIGHT, SMALL, EXPLAINED = 1e-4, 1e-3, 0.01, 0.05, 0.1
TINY = 1e-12  # in a state's unit: no difference
# share of a size that stands out: of noise, of an input's own effect, of a motion unexplained
PART = 1 / 3
HALF = 0.5  # share of one error, or difference, below which another is a different one
GROSS = 0.7  # share of a motion without which little of it is explained
NEARLY_ALL = 0.9  # share of samples, or of a power, that stands for all
FACTOR = 3.0  # between sizes that are no longer alike
FEWEST_SAMPLES = 20  # smallest number of samples from which anything is estimated
STEPS_TO_JUDGE = 10  # smallest number of steps, or of parts of a log, that can be judged
LATEST = 3  # steps by which commands may be sent or logged late
SURELY, REPORTED_FROM = 3.0, 5.0  # standard deviations: of a bound, and of what is reported
MARGIN = 0.8  # [nats] by which any account must lead the others
HINT = MARGIN / 2  # [nats] of plain predictions that are looked at
DECISIVE = 8.0  # [nats] of evidence that another candidate ran
