"""Graphs and algorithms written as LLVM IR text.

Read `llvm_text.py` first (the pen), then `llvm_graph.py` and `llvm_step.py` (a model's step and
Jacobian); the other files are one kernel each: batches, rollouts, the Riccati sweep, box limits,
the DDP loop.
"""
