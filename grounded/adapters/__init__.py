"""Models that other software computes: MuJoCo, JAX, CasADi.

stepper   what the three share: named samples in, arrays through, named samples out
jax       a Model from a JAX function
casadi    a Model from a CasADi function
mujoco    a Model from an MJCF or URDF file: joints are states, actuators or torques are inputs

Read `stepper` first, then `jax`, the shortest. `mujoco_names` says what joints, actuators and
parameters of a file are called, `mujoco_files` what files it is made of; `beside` where a file lies
that a model.py names; `tangent` turns rotations into plain coordinates.
Each adapter imports its library when a model is made, not before.
"""
