"""A cart with feedback and noisy sensors, recorded as a table that begins before the run."""

import numpy as np

from grounded_trials import Workspace
from workspaces import CONFIG, make

LOGGED = CONFIG + "".join(
    f'[log.{kind}.{name}]\npath = "/csv.{name}"\n'
    for kind, name in (("state", "x"), ("state", "v"), ("input", "force"))
)
RATE = 100  # [Hz]


def record(
    w,
    path,
    policy,
    before,
    seed=0,
    until=None,
    after=1.0,
    rate=RATE,
    late=0,
    noise=(0.002, 0.01),
    differs=0,
    turned=False,
    stale=0,
    old=0,
    ahead=0,
    most=np.inf,
):
    """Run a policy on the model against a load, and log everything as a table."""
    model, dt, rng = w.task.model, policy.dt, np.random.default_rng(seed)
    z, force, rows, sent = np.array(w.task.start, float), 0.0, [], policy.past.copy()
    past, acted = [], []
    every, begin = round(dt * rate), round(before * rate)
    end = begin + every * policy.horizon if until is None else begin + round(until * rate)
    last = end + round(after * rate) if until is None else end
    for k in range(last):
        felt = z + rng.normal(0, noise)
        past.append(felt[0])
        felt[0] = past[max(0, k - late)]
        if differs:
            felt[1] = (past[k] - past[max(0, k - differs)]) * rate / differs
        step, part = divmod(k - begin, every)
        if 0 <= step < policy.horizon and part == 0:
            acted.append(felt)
            then = max(0, step - stale)
            if then + ahead < policy.horizon:
                seen = acted[max(0, then - old)]
                force = float(follow(policy, then + ahead, seen, sent)[0])
        force = float(np.clip(force, -most, most))
        if step + ahead >= policy.horizon:
            force = 0.0
        if k < begin:
            force = 0.0
        rows.append([1000 + k / rate, *felt, force])
        push = (-0.7 if turned else 0.7) * force - 0.4 * np.tanh(20 * z[1]) if k >= begin else 0.0
        z = model.system.step(z[None], np.array([[push]]), model.values, 1 / rate)[0]
    return written(path, rows)


def written(path, rows):
    """Write rows of t, x, v, force as a table."""
    np.savetxt(path, rows, "%.5f", ",", header="t,x,v,force", comments="")
    return path


def rows_of(path):
    """Read the rows of a table."""
    return np.loadtxt(path, delimiter=",", skiprows=1)


def stored_from(w, path, before):
    """Return the last trial, the rows of its log and the row of each step, its commands checked."""
    stored, table = w.trials()[-1].trial, rows_of(path)
    k = round(before * RATE) + 5 * np.arange(w.task.horizon)  # all of the run
    np.testing.assert_allclose(stored.inputs[:, 0], table[k, 3], atol=1e-4)
    return stored, table, k


def follow(policy, step, state, past):
    """Compute one command of a policy from its documented law."""
    if policy.gain is None:
        return policy.feedforward[step]
    z = np.concatenate([state, past[: policy.gain.shape[2] - len(state)]])
    u = policy.feedforward[step] + policy.gain[step] @ (z - policy.reference[step])
    past[:] = u = np.clip(u, policy.low, policy.high)
    return u


def waiting(folder, config=LOGGED):
    """Make a workspace that waits for c0002, after c0001 was run."""
    w = Workspace(make(folder / "w", config=config).folder)
    w.ingest(record(w, folder / "first.csv", w.propose().candidate.policy, 0.0, seed=9))
    w.propose()
    return w
