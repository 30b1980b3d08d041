"""Feedback gains that a real robot bears, though no prediction shows that it does not.

oscillation  START HERE: detects limit cycles in trials, and bounds gains by what ran quietly
margin       checks gains under noise and with old samples before they run
sample_age   finds how old the samples are that the robot's program acts on
"""
