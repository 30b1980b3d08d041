"""Signals in other units than the model's: degrees, millimetres, percent, milliseconds.

odd_trial    START HERE: trials in other units than the rest, or all of them in degrees
other_units  a position that does not fit its velocity by a power of ten; time stamps
plane_units  lengths that only the model shows: positions without velocities, or all lengths
mismatch     rates made of several sensors: the one change of a log that fixes them
"""
