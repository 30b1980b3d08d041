"""Three engines that step, differentiate and solve: compiled, traced, differenced.

Read `interpreted.py` first (what the NumPy engines share: rollouts, the Riccati sweep), then
`differenced.py` (any Python function), `traced.py` (exact derivatives) and `compiled.py` (machine
code, by `jit.py` through the disk cache; `arguments.py` is what its kernels are called with).
"""
