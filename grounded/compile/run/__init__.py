"""Two engines that step, differentiate and solve: compiled and differenced.

Read `interpreted.py` first (what an engine answers, in NumPy), then `differenced.py` (any Python
function) and `compiled.py` (machine code, by `jit.py` through the disk cache; `arguments.py` is
what its kernels are called with).
"""
