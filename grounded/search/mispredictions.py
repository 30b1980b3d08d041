"""Correct the DERIVATIVES of the grounded model from the mispredictions of earlier trials.

The grounded model is exact along the incumbent's trial, but its derivatives there are the crude
model's. Another trial j differs from that trial by x_j - x and u_j - u. The error of the grounded
model's prediction of one of its steps,

    y_jt = x_j,t+1 - (f(x_jt, u_jt) + bias_t),        zero for the incumbent itself,

is, to first order, the effect of the error of the derivatives. A trial gives H such vectors, far
more information than its utility alone. Two linear laws are fitted to them, each constant over the
run, the second one to the residuals of the first:

    1. y_t = f_u,t D [dx_t, du_t, du_t-1, v_t-1]   what acts where the inputs act: a lag, a gain, a
                                                   load; v is y in units of the inputs
    2. y_t = E [dx_t, du_t]                        what acts elsewhere

Each is a ridge regression. Its penalty, and how fast the weight of trials decreases with their
distance from the incumbent, are chosen by cross-validation over parts of the run (Stone,
"Cross-validatory choice and assessment of statistical predictions", J. R. Stat. Soc. B 36, 1974).

The choice between the crude and the corrected derivatives is made by leaving out the nearest trials
in turn. Each model, fitted to the others, runs the policy of the trial left out. What counts is the
share of that trial's difference from the incumbent's (`apart`, in units of the cost) that the model
does not predict; the model with the lower value is used. Steps that were made with corrected
derivatives and lost are also left out in turn, at any distance: laws that such a trial refutes
still predict trials nearby. With a single other trial nothing can be left out: the value is then at
least the share of the mispredictions that law 1 leaves in the held-out parts of the run.

The laws hold at all times of a run. Two trials determine them, but no such law describes tyres that
lose grip, a filter on top of a wrong inertia, or a pusher that sticks and slides. So once two steps
from the incumbent have lost, each step t also gets a law of its own for what those laws C leave of
its mispredictions (`believed_by_step`),

    y_jt - C_t d_jt = E_t [dx_jt, du_jt]        for every trial j

A dozen trials determine E_t in a dozen directions at most. Ridge regression leaves it zero in all
others, as a secant method leaves the derivatives across its steps (Broyden, "A class of methods for
solving nonlinear simultaneous equations", Math. Comp. 19, 1965), with the nearest trials weighted
most. Lost trials count as much as others: nothing else shows what a step does that lost. These
derivatives make a step if it promises more than any other (`improve`), and the steps after that.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from grounded.compile.problem import Problem
from grounded.frozen import Array, wrapped
from grounded.policy import Policy
from grounded.rollout import Run, apart, augmented
from grounded.search.candidate import Tried
from grounded.search.corrected import Corrected, runs
from grounded.search.planner import Planner
from grounded.solve.bias import input_span
from grounded.trial import mean_trial

PRICES = (1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0)  # ridge penalties
FADING = (0.0, 2.0)  # the weight of a trial is its distance to minus this power
PRICE_BY_STEP = 0.03  # the same for the laws of single steps
PARTS = 8  # parts of the run for cross-validation
NEAREST = 12  # nearest trials that are used
ASKED = 3  # nearest trials that are left out in turn
LATEST = 100  # latest trials that these are chosen from
DEAD = 1e-4  # regularisation, relative to the mean square effect of the inputs


@dataclass(frozen=True, eq=False)
class Seen:
    """A trial and its mispredictions by the grounded model; u is what the actuators received."""

    x: Array  # (H, n)
    u: Array  # (H, m)
    before: Array  # (H, m) u one step earlier
    y: Array  # (H, n) what was mispredicted
    run: Run  # its states and the inputs as sent
    policy: Policy


def believed(
    planner: Planner,
    incumbent: Tried,
    history: Sequence[Tried],
    grounded: Problem,
) -> Corrected | None:
    """Return the exact grounded model with corrected derivatives, if those predict better."""
    known = neighbours(planner, incumbent, history, grounded)
    if known is None:
        return None
    own, nearest = known
    others = [o for o, _ in nearest]
    refuting = [o for o, t in nearest[ASKED:] if t.candidate.of_corrected and t.lost]

    asked = others[:ASKED] + refuting[:ASKED]
    rests = [[o for o in others if o is not other] for other in asked]
    fits = [laws(own, rest or others, grounded) for rest in rests]
    crude = unforetold([grounded] * len(asked), own, asked)
    fitted = [
        (k, with_law(law, own, grounded)) for k, (law, _) in enumerate(fits) if law is not None
    ]
    models = [made.on(grounded) for _, made in fitted]
    missed = unforetold(models, own, [asked[k] for k, _ in fitted])
    shares = dict(zip([k for k, _ in fitted], missed, strict=True))
    corrected = [
        shares.get(k, 1.0) if rests[k] else max(shares.get(k, 1.0), left)
        for k, (_, left) in enumerate(fits)
    ]
    law, _ = laws(own, others, grounded)
    if law is None or float(np.mean(crude)) <= float(np.mean(corrected)):
        return None
    return with_law(law, own, grounded)


def neighbours(
    planner: Planner, incumbent: Tried, history: Sequence[Tried], grounded: Problem
) -> tuple[Seen, list[tuple[Seen, Tried]]] | None:
    """Return the incumbent's trial and the other ones, nearest first; None if there are none."""
    own = seen(planner, incumbent, grounded)
    if own is None:
        return None
    told = [t for t in history[-LATEST:] if t is not incumbent and np.isfinite(t.utility)]
    ran = [(o, t) for t in told if (o := seen(planner, t, grounded)) is not None]
    moved = [apart(grounded, o.run, own.run) for o, _ in ran]
    nearest = [ran[j] for j in np.argsort(moved, kind="stable") if moved[j] > 0]
    return (own, nearest) if nearest else None


def with_law(law: Array, own: Seen, grounded: Problem) -> Corrected:
    """Return the model with a law (H, n, 2 n + 2 m) added."""
    return Corrected(grounded.system, law, own.x, own.u, own.before)


def unforetold(models: Sequence[Problem], own: Seen, others: Sequence[Seen]) -> list[float]:
    """Return the share of each trial's difference from the incumbent's that its model mispredicts.

    There is one model for each of the other trials; they are alike except for their laws.
    """
    found = runs(models, [other.policy for other in others])
    return [
        min(
            1.0,
            apart(model, (run.states, run.inputs), other.run) / apart(model, own.run, other.run),
        )
        for model, run, other in zip(models, found, others, strict=True)
    ]


def seen(planner: Planner, tried: Tried, grounded: Problem) -> Seen | None:
    """Return the mean trial of a candidate with its mispredictions; None if it is incomplete."""
    H, mask = grounded.horizon, planner.task.model.angle_mask
    trial = planner.lift(mean_trial(tried.trials, mask))
    if trial.finite_steps < H:
        return None
    trial = trial.until(H)
    past = grounded.past if trial.start_inputs is None else trial.start_inputs
    z = augmented(grounded, trial.states, trial.inputs, past)
    u = grounded.queue.effective(z[:-1], trial.inputs)
    x = np.ascontiguousarray(trial.states[:-1])
    moved = grounded.system.step(x, received(grounded, u), grounded.p, grounded.dt)
    y = wrapped(trial.states[1:] - moved - grounded.bias, grounded.angles)
    run = (trial.states, trial.inputs)
    return Seen(x, u, np.vstack([u[:1], u[:-1]]), y, run, tried.candidate.policy)


def received(problem: Problem, u: Array) -> Array:
    """Return the inputs of the model for what the actuators received, u (H, m)."""
    return np.ascontiguousarray(u if problem.input_shift is None else u - problem.input_shift)


def laws(own: Seen, others: Sequence[Seen], grounded: Problem) -> tuple[Array | None, float]:
    """Fit laws 1 and 2, the error of the derivatives with respect to [x, u, u before, y before].

    Returns:
        The sum of the laws (H, n, 2 n + 2 m), or None if no trial differs from the incumbent's; and
        the share of the mispredictions that law 1 leaves in held-out parts of the run.
    """
    d, y, far = moved_near(own, others, grounded)
    if not len(far):
        return None, 1.0
    n, m = own.x.shape[1], own.u.shape[1]
    f_u, by_input = _matching(own, y / far[:, None, None], grounded, input_span(grounded, own.u))
    v = np.einsum("tmn,jtn->jtm", by_input, y)
    v_before = np.concatenate([np.zeros_like(v[:, :1]), v[:, :-1]], axis=1)
    D, missed = shared(np.concatenate([d[:, :, : n + 2 * m], v_before], axis=2), v, far)
    law = np.zeros((len(own.x), n, 2 * n + 2 * m))
    law[:, :, : n + 2 * m] = f_u @ D[:, : n + 2 * m]
    law[1:, :, n + 2 * m :] = f_u[1:] @ D[:, n + 2 * m :] @ by_input[:-1]
    now = d[:, :, : n + m]
    law[:, :, : n + m] += shared(now, y - np.einsum("tnq,jtq->jtn", law, d), far)[0]
    return law, missed


def moved_near(own: Seen, others: Sequence[Seen], grounded: Problem) -> tuple[Array, Array, Array]:
    """Return what the nearest trials (j) that differ from the incumbent's show of the derivatives.

    These are their differences in [x, u, u before, y before] (j, H, 2 n + 2 m), mispredictions
    (j, H, n) and distances (j,), the nearest first.
    """
    span = input_span(grounded, own.u)
    reach = np.ptp(own.x, axis=0) + 1e-9
    moves = [_features(own, other, grounded) for other in others]
    n, m = own.x.shape[1], own.u.shape[1]
    far = np.array([_rms(d[:, :n] / reach) + _rms(d[:, n : n + m] / span) for d in moves])
    near = [int(j) for j in np.argsort(far, kind="stable")[:NEAREST] if far[j] > 1e-9]
    return np.array([moves[j] for j in near]), np.array([others[j].y for j in near]), far[near]


def _features(own: Seen, other: Seen, grounded: Problem) -> Array:
    """Return a trial's differences in [x, u, u before, y before], (H, 2 n + 2 m)."""
    y_before = np.vstack([np.zeros_like(other.y[:1]), other.y[:-1]])
    x = wrapped(other.x - own.x, grounded.angles)
    return np.hstack([x, other.u - own.u, other.before - own.before, y_before])


def _rms(a: Array) -> float:
    return float(np.sqrt(np.mean(a**2)))


def _matching(own: Seen, y: Array, grounded: Problem, span: Array) -> tuple[Array, Array]:
    """Return f_u (H, n, m) along the incumbent, and its weighted pseudo-inverse (H, m, n)."""
    scale = np.sqrt(np.mean(y**2, axis=(0, 1)))
    scale = np.maximum(scale, 1e-6 * scale.max()) + 1e-300
    _, f_u = grounded.system.linearise(own.x, received(grounded, own.u), grounded.p, grounded.dt)
    B = f_u * span / scale[:, None]
    gram = np.einsum("tni,tnj->tij", B, B)
    dead = DEAD * float(np.trace(gram, axis1=1, axis2=2).mean()) / len(span) + 1e-300
    back = np.linalg.solve(gram + dead * np.eye(len(span)), B.transpose(0, 2, 1))
    return f_u, span[:, None] * back / scale


def shared(d: Array, y: Array, far: Array) -> tuple[Array, float]:
    """Fit the law y_t = C d_t, constant over the run, to trials by ridge regression.

    d are features (j, H, q), y mispredictions (j, H, k), far distances from the incumbent (j,).

    Returns:
        C (k, q), and the share of y that it leaves in held-out parts of the run; zeros and 1 if no
        law predicts those.
    """
    d, y = d / far[:, None, None], y / far[:, None, None]
    scale = np.sqrt(np.mean(d**2, axis=(0, 1))) + 1e-12
    d = d / scale
    near = (far / far[0]) ** -2.0
    size = np.einsum("j,jtk->k", near, y**2) * y.shape[2] + 1e-300
    parts, best = np.array_split(np.arange(d.shape[1]), PARTS), 1.0
    law = np.zeros((d.shape[2], y.shape[2]))
    ridges = np.multiply.outer(PRICES, np.eye(len(law)))
    for fading in FADING:
        weight = (far / far[0]) ** -fading
        M = np.array([np.einsum("j,jtp,jtq->pq", weight, d[:, t], d[:, t]) for t in parts])
        N = np.array([np.einsum("j,jtp,jtk->pk", weight, d[:, t], y[:, t]) for t in parts])
        each = np.linalg.solve(M.sum(axis=0) - M + ridges[:, None], (N.sum(axis=0) - N)[None])
        off = [
            y[:, t] - d[:, t] @ C[:, None] for t, C in zip(parts, each.swapaxes(0, 1), strict=True)
        ]
        lefts = sum(np.einsum("j,pjtk,k->p", near, e**2, 1 / size) for e in off)
        for left, ridge in zip(lefts.tolist(), ridges, strict=True):
            if left < best:
                best, law = left, np.linalg.solve(M.sum(axis=0) + ridge, N.sum(axis=0))
    return (law / scale[:, None]).T, best


# --- each step of the run by itself ---------------------------------------------------------------


def believed_by_step(
    planner: Planner, incumbent: Tried, history: Sequence[Tried], grounded: Problem
) -> Corrected | None:
    """Return the exact grounded model with derivatives corrected step by step.

    None if fewer than two other trials are known, or if it does not predict those that are left
    out.
    """
    known = neighbours(planner, incumbent, history, grounded)
    if known is None or len(known[1]) < 2:
        return None
    own, others = known[0], [other for other, _ in known[1]]
    asked = others[:ASKED]
    rests = [laws_by_step([o for o in others if o is not one], own, grounded) for one in asked]
    missed = unforetold([with_law(law, own, grounded).on(grounded) for law in rests], own, asked)
    if not np.mean(missed) < 1.0:
        return None
    law = laws_by_step(others, own, grounded)
    return with_law(law, own, grounded)


def laws_by_step(others: Sequence[Seen], own: Seen, grounded: Problem) -> Array:
    """Return the laws of the whole run plus those of each step, (H, n, 2 n + 2 m)."""
    d, y, far = moved_near(own, others, grounded)
    made, _ = laws(own, others, grounded)
    if made is None:
        made = np.zeros((*own.x.shape, d.shape[2]))

    # what the laws of the whole run leave, in units of each trial's distance from the incumbent's
    left = (y - np.einsum("tnq,jtq->jtn", made, d)) / far[:, None, None]
    both = own.x.shape[1] + own.u.shape[1]
    d = d[:, :, :both] / far[:, None, None]
    scale = np.sqrt(np.mean(d**2, axis=(0, 1))) + 1e-12
    d, weight = d / scale, (far / far[0]) ** -2.0
    M = np.einsum("j,jtp,jtq->tpq", weight, d, d)
    N = np.einsum("j,jtp,jtk->tpk", weight, d, left)
    E = np.linalg.solve(M + PRICE_BY_STEP * np.eye(both), N) / scale[:, None]
    made[:, :, :both] += E.transpose(0, 2, 1)
    return made
