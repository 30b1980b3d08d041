"""Three engines that step, differentiate and solve: compiled, traced, differenced.

Read `interpreted.py` first (what the NumPy engines share), then `differenced.py` (any Python
function), `traced.py` (exact derivatives) and `compiled.py` (machine code, by `jit.py` through the
disk cache).
"""
