"""The two models of the benchmark, written once for NumPy, CasADi and JAX alike.

`xp` is numpy, jax.numpy or casadi's functions; x, u, p are sequences of numbers, arrays or symbols.
The aircraft is `grounded.models.aircraft`, state for state; the car is `grounded.models.car`
without its stall and its braking, so that every solver sees smooth functions.
"""

from __future__ import annotations

import math

GRAVITY = 9.81
CAR_STATES = ("delta", "v", "x", "y", "psi", "psi_rate")
CAR_INPUTS = ("steering", "throttle")
CAR_PARAMS = {
    "a1": 0.45, "b1": 0.0, "a2": 3.0, "b2": -0.3, "tau_delta": 0.1, "tau_v": 0.4, "L": 0.15,
}  # fmt: skip
AIR_STATES = (
    "north", "east", "altitude", "u", "v", "w", "phi", "theta", "psi", "p", "q", "r",
)  # fmt: skip
AIR_INPUTS = ("throttle", "aileron", "elevator", "rudder")


def car(x, u, p, xp):
    delta, v, _, _, psi, _ = x
    a1, b1, a2, b2, tau_delta, tau_v, L = p
    delta_dot = (a1 * u[0] + b1 - delta) / tau_delta
    v_dot = (a2 * u[1] + b2 - v) / tau_v
    cd, sd = xp.cos(delta), xp.sin(delta)
    return [
        delta_dot,
        v_dot,
        v * cd * xp.cos(psi),
        v * cd * xp.sin(psi),
        v * sd / L,
        (v_dot * sd + v * cd * delta_dot) / L,
    ]


def aircraft(x, u, p, xp):
    _, _, _, U, v, w, phi, theta, psi, P, Q, R = x
    throttle, aileron, elevator, rudder = u
    (
        mass, Jx, Jy, Jz, Jxz, S, b, c, rho, S_prop, C_prop, k_motor, z_T, k_Q, CL0, CLa, CLq, CLde,
        alpha_s, M_s, CD0, e_osw, CDde, CDb, Cm0, Cma, Cmq, Cmde, CYb, CYp, CYr, CYda, CYdr, Clb,
        Clp, Clr, Clda, Cldr, Cnb, Cnp, Cnr, Cnda, Cndr,
    ) = p  # fmt: skip
    V = xp.sqrt(U**2 + v**2 + w**2)
    alpha, beta = xp.arctan2(w, U), xp.arcsin(v / V)
    qS = 0.5 * rho * V**2 * S
    roll, pitch, yaw = b * P / (2 * V), c * Q / (2 * V), b * R / (2 * V)
    up, down = xp.exp(-M_s * (alpha - alpha_s)), xp.exp(M_s * (alpha + alpha_s))
    sigma = (1 + up + down) / ((1 + up) * (1 + down))
    ca, sa = xp.cos(alpha), xp.sin(alpha)
    linear = CL0 + CLa * alpha
    plate = 2 * sa * xp.sqrt(sa * sa + 1e-12) * ca
    CL = (1 - sigma) * linear + sigma * plate + CLq * pitch + CLde * elevator
    CD = CD0 + linear**2 / (math.pi * e_osw * b**2 / S) + CDde * elevator**2 + CDb * beta**2
    CY = CYb * beta + CYp * roll + CYr * yaw + CYda * aileron + CYdr * rudder
    Cl = Clb * beta + Clp * roll + Clr * yaw + Clda * aileron + Cldr * rudder
    Cm = Cm0 + Cma * alpha + Cmq * pitch + Cmde * elevator
    Cn = Cnb * beta + Cnp * roll + Cnr * yaw + Cnda * aileron + Cndr * rudder
    thrust = 0.5 * rho * S_prop * C_prop * ((k_motor * throttle) ** 2 - V**2)
    X, Z, Y = qS * (CL * sa - CD * ca) + thrust, -qS * (CL * ca + CD * sa), qS * CY
    L, M, N = qS * b * Cl - k_Q * thrust, qS * c * Cm + z_T * thrust, qS * b * Cn
    cphi, sphi, cth, sth = xp.cos(phi), xp.sin(phi), xp.cos(theta), xp.sin(theta)
    cpsi, spsi = xp.cos(psi), xp.sin(psi)
    gamma = Jx * Jz - Jxz**2
    rolling = L + Jxz * P * Q + (Jy - Jz) * Q * R
    yawing = N - Jxz * Q * R + (Jx - Jy) * P * Q
    turn = Q * sphi + R * cphi
    ahead, aside = U * cth + (v * sphi + w * cphi) * sth, v * cphi - w * sphi
    return [
        ahead * cpsi - aside * spsi,
        ahead * spsi + aside * cpsi,
        U * sth - (v * sphi + w * cphi) * cth,
        R * v - Q * w - GRAVITY * sth + X / mass,
        P * w - R * U + GRAVITY * sphi * cth + Y / mass,
        Q * U - P * v + GRAVITY * cphi * cth + Z / mass,
        P + sth / cth * turn,
        Q * cphi - R * sphi,
        turn / cth,
        (Jz * rolling + Jxz * yawing) / gamma,
        ((Jz - Jx) * P * R - Jxz * (P**2 - R**2) + M) / Jy,
        (Jxz * rolling + Jx * yawing) / gamma,
    ]


RATES = {"car": car, "aircraft": aircraft}


def rk4(rate, x, u, p, dt, xp):
    """One Runge-Kutta step of lists."""

    def moved(k, h):
        return [a + h * b for a, b in zip(x, k, strict=True)]

    k1 = rate(x, u, p, xp)
    k2 = rate(moved(k1, dt / 2), u, p, xp)
    k3 = rate(moved(k2, dt / 2), u, p, xp)
    k4 = rate(moved(k3, dt), u, p, xp)
    return [
        a + dt / 6 * (b + 2 * c + 2 * d + e)
        for a, b, c, d, e in zip(x, k1, k2, k3, k4, strict=True)
    ]
