"""An aircraft's roll that follows its command with a lag, as autopilots log it."""

import numpy as np

DT, TAU, N = 0.02, 0.25, 400
T = np.arange(N) * DT
WANTED = 0.4 * np.sign(np.sin(1.7 * T)) + 0.2 * np.sin(3 * T)  # [rad]
ROLL = np.zeros(N)  # from level
for i in range(1, N):
    ROLL[i] = ROLL[i - 1] + (1 - np.exp(-DT / TAU)) * (WANTED[i - 1] - ROLL[i - 1])
