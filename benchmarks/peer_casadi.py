"""CasADi: multiple shooting, exact sparse derivatives in its virtual machine, IPOPT or fatrop.

The z of each node includes the previous input, as in the whole benchmark.
"""

from __future__ import annotations

import sys
import time

import casadi as ca
import numpy as np
from peer_data import fastest, load, reached, report, rk4

ca.abs = ca.fabs  # NumPy's name
case = load(ca)
solver_name = sys.argv[3] if len(sys.argv) > 3 else "ipopt"
n, m, H = case.n, case.m, case.H
started = time.process_time()

x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
after = ca.vertcat(*rk4(case.rate, ca.vertsplit(x), ca.vertsplit(u), case.p.tolist(), case.dt))
F = ca.Function("F", [x, u], [after])

X = [ca.MX.sym(f"x{t}", n + m) for t in range(H + 1)]
U = [ca.MX.sym(f"u{t}", m) for t in range(H)]
cost, g, w, guess = 0, [], [], []
for t in range(H + 1):
    e = X[t][:n] - case.target[t]
    cost += ca.dot(case.weight[t], e * e)
    w.append(X[t])
    guess.append(case.z[t])
    if t == H:
        break
    d = U[t] - X[t][n:]
    cost += ca.dot(case.R, U[t] * U[t]) + ca.dot(case.S, d * d)
    g.append(X[t + 1] - ca.vertcat(F(X[t][:n], U[t]), U[t]))
    if t == 0:
        g.append(X[0] - np.concatenate([case.start, case.past]))
    w.append(U[t])
    guess.append(case.u[t])
nlp = {"x": ca.vertcat(*w), "f": cost, "g": ca.vertcat(*g)}
options = {"print_time": False, "expand": False}
if solver_name == "ipopt":
    options |= {"ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-6}
else:
    options |= {
        "structure_detection": "auto",
        "equality": [True] * int(nlp["g"].numel()),
        "fatrop.print_level": 0,
        "fatrop.tol": 1e-6,
    }
solver = ca.nlpsol("solver", solver_name, nlp, options)
built = time.process_time() - started
start = np.concatenate(guess)
found = solver(x0=start, lbg=0, ubg=0)
value = float(found["f"])
stats = solver.stats()
report(
    peer=f"CasADi + {solver_name}",
    version=ca.__version__,
    case=case.name,
    ms=1e3 * fastest(lambda: solver(x0=start, lbg=0, ubg=0), case.repeats),
    iterations=stats.get("iter_count"),
    cost=value,
    reached=reached(case, value),
    build_s=built,
)
