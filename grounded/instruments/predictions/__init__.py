"""Faults of a log that only the model's predictions show.

short_runs        START HERE: predictions a quarter of a second ahead, calibrated on the trial
mistaken          exchanged commands, commands in percent, signs of sensors
exchanged_states  two state columns that are exchanged
input_signs       an input that acts the other way round in some trials
clocks            states that respond before their command is sent; stamps at a wrong rate
unresolved        a body that becomes too fast for the model's time step
time_step         an integrator's step that is too long for the model
"""
