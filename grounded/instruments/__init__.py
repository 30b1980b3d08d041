"""Checks of the sensors and commands in a log, before any physics is identified from it.

Delays, scales, wrong units and signs, stuck or dead signals. Read `preflight` first: it checks
trials against the model's kinematics, returns a `Finding` for each fault, and corrects the trials
where that is certain. `single` checks one signal at a time, `kinematics` a position against its
velocity and a heading against the course travelled, `mismatch` a position against every state that
its rate depends on (`rows`). `lag` measures the delay between two signals.
"""
