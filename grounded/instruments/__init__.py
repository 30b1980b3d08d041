"""Checks of the sensors and commands in a log, before any physics is identified from it.

Delays, scales, wrong units and signs, stuck or dead signals. Read `preflight` first: it checks
trials against the model's kinematics, returns a `Finding` for each fault, and corrects the trials
where that is certain. `sound_trials` runs these checks and those by the model's predictions.

single        one signal at a time
inputs        commands: copies, limits
halted        where a robot stands still under commands that had moved it before
lag           the delay between two signals of one quantity
kinematics/   what positions, velocities and headings imply about each other, whatever the physics
predictions/  what only the model's predictions show: exchanged commands, signs, clocks
units/        degrees, millimetres, percent: in one trial, one signal, or all of them
"""
