"""How a log came about: which story of its sensors and commands explains it best.

Read `sound_trials` first, which asks all of it in one call, then `judge`.

table         the accounts: units, signs, exchanges, offsets, dead sensors, stamps
kinematics    what positions, velocities and headings imply of each other
motion        what the model predicts, calibrated on the log
judge         scores each account by both, tells the best, corrects or refuses
reported      what is said of an account, and what to do about it
returned      how the commands of a candidate's run came about: the same table, and what its
              program did; by `sent` (a run beside its policy and its prediction)
ages          late and filtered sensors, velocities computed from positions, biases; by `lag`
commands      clocks that differ, inputs that act in reverse
signals       samples of one sensor; copies and limits of commands
time_step     models and motions that are too fast for the steps
levels        the numbers by which all of them judge
finding       one fault of a sensor or command, and the corrected trials
"""
