"""Models that other software computes: MuJoCo, JAX, CasADi.

mujoco    a Model from an MJCF or URDF file: joints are states, actuators or torques are inputs
jax       a Model from a JAX function
casadi    a Model from a CasADi function
stepper   what the three share: named samples in, arrays through, named samples out

Each adapter imports its library when a model is made, not before.
"""
