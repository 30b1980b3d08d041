"""A small fixed-wing aircraft in six degrees of freedom: 12 states, 4 inputs, 43 parameters.

Section 5.1, footnote 13: a one-kilogram wing-body of 1.5 m span that flies at 10 m/s. The paper
names neither its equations nor its 43 numbers; this is the flat-Earth, body-axes model of Stevens
& Lewis, *Aircraft Control and Simulation* (2nd ed. 2003, Table 2.4-1), with the force and moment
coefficients linear in the states and inputs, except that lift blends smoothly into a flat plate's
beyond the stall (Beard & McLain, *Small Unmanned Aircraft*, Eq. 4.8 to 4.11).

    states   north, east, altitude       position, flat Earth [m]
             u, v, w                     velocity along body axes x (nose), y (right), z (down)
             phi, theta, psi             Euler angles roll, pitch, yaw [rad]
             p, q, r                     body rates [rad/s]
    inputs   throttle                    0 to 1
             aileron, elevator, rudder   surface angles [rad]

The states are body velocities, not airspeed and its two angles, so that no equation of motion is
divided by the airspeed or by cos(beta). Signs are those of Stevens & Lewis: a positive elevator
pitches the nose down, a positive rudder yaws it left; here a positive aileron rolls right.

    alpha = atan2(w, u),  beta = asin(v / V),  V = |(u, v, w)|,  qbar = rho V^2 / 2
    T = rho S_prop C_prop ((k_motor throttle)^2 - V^2) / 2
"""

from __future__ import annotations

from typing import Any

import numpy as np

from grounded.model import Model, Param

GRAVITY = 9.81  # [m/s2]


def about(value: float, unit: str) -> Param:
    """Return a parameter from a textbook, or scaled, with a standard deviation of 30 %."""
    return Param(value, unit, std=0.3 * abs(value))


# "Zagi" is the flying wing of Beard & McLain, Table E.1, whose moments of inertia scale here with
# the mass (1 / 1.56) and the span squared ((1.5 / 1.4224)^2). It has no rudder and is unstable in
# yaw, so a fin and its derivatives are added: those values are marked "chosen".
PARAMS: dict[str, Param] = {
    "mass": Param(1.0, "kg"),  # paper, footnote 13
    "Jx": about(0.0818, "kg m^2"),  # Zagi 0.1147, scaled
    "Jy": about(0.0411, "kg m^2"),  # Zagi 0.0576, scaled
    "Jz": about(0.1221, "kg m^2"),  # Zagi 0.1712, scaled
    "Jxz": about(0.00107, "kg m^2"),  # Zagi 0.0015, scaled
    "S": Param(0.2879, "m^2"),  # wing area: Zagi 0.2589 (1.5 / 1.4224)^2
    "b": Param(1.5, "m"),  # span: paper, footnote 13
    "c": Param(0.3482, "m"),  # mean chord: Zagi 0.3302 (1.5 / 1.4224)
    "rho": Param(1.2682, "kg/m^3"),  # air density: Beard & McLain, Table E.1
    "S_prop": Param(0.0314, "m^2"),  # Zagi
    "C_prop": about(1.0, "1"),  # Zagi
    "k_motor": about(20.0, "m/s"),  # Zagi
    "z_T": about(0.01, "m"),  # chosen: thrust line below the centre of mass
    "k_Q": about(0.01, "m"),  # chosen: propeller torque per thrust
    "CL0": about(0.09167, "1"),  # Zagi
    "CLa": about(3.5016, "1/rad"),  # Zagi
    "CLq": about(2.8932, "1/rad"),  # Zagi
    "CLde": about(0.2724, "1/rad"),  # Zagi
    "alpha_s": about(0.4712, "rad"),  # stall angle: Zagi alpha_0
    "M_s": about(50.0, "1"),  # sharpness of the stall: Zagi M
    "CD0": about(0.04171, "1"),  # Zagi: C_D0 0.01631 + C_Dp 0.0254
    "e_osw": about(0.9, "1"),  # Oswald's efficiency: Zagi
    "CDde": about(0.3045, "1/rad^2"),  # Zagi's C_Dde, used with the square (smooth)
    "CDb": about(0.1, "1/rad^2"),  # chosen: drag of sideslip
    "Cm0": about(-0.02338, "1"),  # Zagi
    "Cma": about(-0.5675, "1/rad"),  # Zagi
    "Cmq": about(-1.399, "1/rad"),  # Zagi
    "Cmde": about(-0.3254, "1/rad"),  # Zagi
    "CYb": about(-0.2, "1/rad"),  # chosen, fin added: Zagi -0.07359, Aerosonde -0.98
    "CYp": about(-0.01, "1/rad"),  # chosen: Zagi 0
    "CYr": about(0.05, "1/rad"),  # chosen: Zagi 0
    "CYda": about(0.01, "1/rad"),  # chosen: Zagi 0, Aerosonde 0.075
    "CYdr": about(0.1, "1/rad"),  # chosen, fin rudder: Aerosonde 0.19
    "Clb": about(-0.02854, "1/rad"),  # Zagi
    "Clp": about(-0.3209, "1/rad"),  # Zagi
    "Clr": about(0.03066, "1/rad"),  # Zagi
    "Clda": about(0.1682, "1/rad"),  # Zagi
    "Cldr": about(0.0024, "1/rad"),  # Aerosonde, 2nd edition
    "Cnb": about(0.03, "1/rad"),  # chosen, fin added: Zagi -0.0004, Aerosonde 0.073
    "Cnp": about(-0.01297, "1/rad"),  # Zagi
    "Cnr": about(-0.03, "1/rad"),  # chosen, fin added: Zagi -0.00434, Aerosonde -0.095
    "Cnda": about(-0.00328, "1/rad"),  # Zagi
    "Cndr": about(-0.03, "1/rad"),  # chosen: Aerosonde -0.069
}


def lift_coefficient(alpha: Any, p: Any) -> Any:
    """Return the wing's lift coefficient at an angle of attack [rad]; a flat plate's past stall.

    Beard & McLain, Eq. 4.9 and 4.10: sigma rises from 0 to 1 around +-alpha_s.
    """
    up = np.exp(-p.M_s * (alpha - p.alpha_s))
    down = np.exp(p.M_s * (alpha + p.alpha_s))
    sigma = (1 + up + down) / ((1 + up) * (1 + down))
    plate = 2 * np.sin(alpha) * np.abs(np.sin(alpha)) * np.cos(alpha)
    return (1 - sigma) * (p.CL0 + p.CLa * alpha) + sigma * plate


def forces_and_moments(s: Any, a: Any, p: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
    """Return forces X, Y, Z [N] and moments L, M, N [N m] in body axes, with propulsion."""
    V = np.sqrt(s.u**2 + s.v**2 + s.w**2)
    alpha = np.arctan2(s.w, s.u)
    beta = np.arcsin(s.v / V)
    qS = 0.5 * p.rho * V**2 * p.S
    roll, pitch, yaw = p.b * s.p / (2 * V), p.c * s.q / (2 * V), p.b * s.r / (2 * V)

    linear_lift = p.CL0 + p.CLa * alpha
    induced = linear_lift**2 / (np.pi * p.e_osw * p.b**2 / p.S)
    CL = lift_coefficient(alpha, p) + p.CLq * pitch + p.CLde * a.elevator
    CD = p.CD0 + induced + p.CDde * a.elevator**2 + p.CDb * beta**2
    CY = p.CYb * beta + p.CYp * roll + p.CYr * yaw + p.CYda * a.aileron + p.CYdr * a.rudder
    Cl = p.Clb * beta + p.Clp * roll + p.Clr * yaw + p.Clda * a.aileron + p.Cldr * a.rudder
    Cm = p.Cm0 + p.Cma * alpha + p.Cmq * pitch + p.Cmde * a.elevator
    Cn = p.Cnb * beta + p.Cnp * roll + p.Cnr * yaw + p.Cnda * a.aileron + p.Cndr * a.rudder

    thrust = 0.5 * p.rho * p.S_prop * p.C_prop * ((p.k_motor * a.throttle) ** 2 - V**2)
    ca, sa = np.cos(alpha), np.sin(alpha)
    X = qS * (CL * sa - CD * ca) + thrust
    Z = -qS * (CL * ca + CD * sa)
    return (
        X,
        qS * CY,
        Z,
        qS * p.b * Cl - p.k_Q * thrust,
        qS * p.c * Cm + p.z_T * thrust,
        qS * p.b * Cn,
    )


def dynamics(s: Any, a: Any, p: Any) -> dict[str, Any]:
    """Return ds/dt by the flat-Earth body-axes equations (Stevens & Lewis 2003, Table 2.4-1)."""
    X, Y, Z, L, M, N = forces_and_moments(s, a, p)
    cphi, sphi = np.cos(s.phi), np.sin(s.phi)
    cth, sth = np.cos(s.theta), np.sin(s.theta)
    cpsi, spsi = np.cos(s.psi), np.sin(s.psi)
    gamma = p.Jx * p.Jz - p.Jxz**2
    roll = L + p.Jxz * s.p * s.q + (p.Jy - p.Jz) * s.q * s.r  # moments with gyroscopic terms
    yaw = N - p.Jxz * s.q * s.r + (p.Jx - p.Jy) * s.p * s.q
    turn = s.q * sphi + s.r * cphi
    ahead = s.u * cth + (s.v * sphi + s.w * cphi) * sth  # horizontal, along the heading
    aside = s.v * cphi - s.w * sphi  # horizontal, to its right
    return {
        "north": ahead * cpsi - aside * spsi,
        "east": ahead * spsi + aside * cpsi,
        "altitude": s.u * sth - (s.v * sphi + s.w * cphi) * cth,
        "u": s.r * s.v - s.q * s.w - GRAVITY * sth + X / p.mass,
        "v": s.p * s.w - s.r * s.u + GRAVITY * sphi * cth + Y / p.mass,
        "w": s.q * s.u - s.p * s.v + GRAVITY * cphi * cth + Z / p.mass,
        "phi": s.p + sth / cth * turn,
        "theta": s.q * cphi - s.r * sphi,
        "psi": turn / cth,
        "p": (p.Jz * roll + p.Jxz * yaw) / gamma,
        "q": ((p.Jz - p.Jx) * s.p * s.r - p.Jxz * (s.p**2 - s.r**2) + M) / p.Jy,
        "r": (p.Jxz * roll + p.Jx * yaw) / gamma,
    }


model = Model(
    name="aircraft",
    states={
        "north": "m",
        "east": "m",
        "altitude": "m",
        "u": "m/s",
        "v": "m/s",
        "w": "m/s",
        "phi": "rad",
        "theta": "rad",
        "psi": "rad",
        "p": "rad/s",
        "q": "rad/s",
        "r": "rad/s",
    },
    inputs={"throttle": "1", "aileron": "rad", "elevator": "rad", "rudder": "rad"},
    params=PARAMS,
    angles=("phi", "theta", "psi"),
    roles={
        "position": ("north", "east"),
        "altitude": "altitude",
        "heading": "psi",
        "speed": "u",
        "attitude": ("phi", "theta", "psi"),
        "rates": ("p", "q", "r"),
    },
    derivative=dynamics,
    integrator="rk4",
)
