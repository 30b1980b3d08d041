"""Models computed by other software: MuJoCo, JAX, CasADi.

stepper   base class: converts between named samples and arrays
jax       a Model from a JAX function
casadi    a Model from a CasADi function
mujoco    a Model from an MJCF or URDF file: joints are states, actuators or torques are inputs

Read `stepper` first, then `jax`, the shortest. `mujoco_names` names the joints, actuators and
parameters of a file; `files` finds files that a model.py names, and those that they include;
`tangent` converts rotations to plain coordinates.
Each adapter imports its library only when a model is made.
"""
