"""The best known run of the simulator itself, as the optimum of a set-up.

Candidates are the end of the search, DDP with the simulator as a Model (if it can be one), and each
of these polished by Gauss-Newton on the robot. The derivatives by the feed-forward are differences:
one run for every input of every step, with the policy's gains kept. The best candidate counts. This
takes thousands of runs, so it is computed once and kept in optima.json:

    python -m benchmarks.foreign --optimum [--only NAME]
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from benchmarks.foreign.setups import Setup
from grounded.compile.problem import DescentOptions
from grounded.policy import Policy
from grounded.search.ask_tell import learn
from grounded.search.first_policy import first_policy
from grounded.search.step_size import SearchOptions
from grounded.solve import ddp
from grounded.trial import Trial

FILE = Path(__file__).with_name("optima.json")
SHIFT = 1e-4  # of the range of an input: the step of the differences
ROUNDS, GAIN = 25, 5e-5  # at most; least relative gain of one
LOST = 1e3  # residual of every step after a run has ended early


def known() -> dict[str, dict[str, object]]:
    """Return utility and origin of the optima computed so far."""
    return json.loads(FILE.read_text()) if FILE.is_file() else {}


def remember(name: str, utility: float, origin: str) -> None:
    """Keep the better of the known optimum and this one."""
    found = known()
    if name not in found or utility > found[name]["utility"]:
        found[name] = {"utility": utility, "from": origin}
        FILE.write_text(json.dumps(dict(sorted(found.items())), indent=1) + "\n")


def optimum(setup: Setup, say=lambda line: None) -> tuple[float, str]:
    """Return the best utility found with the simulator's own derivatives, and how."""
    best = learn(setup.task, lambda one: setup.run(one.policy), SearchOptions()).standing.incumbent
    starts = {} if best is None else {"the search": best.candidate.policy}
    if setup.truth is not None:
        for policy in (*[*starts.values()], first_policy(setup.task)[0]):
            options = DescentOptions(max_iterations=40)
            solved = ddp.solve(setup.truth.problem(), policy.feedforward, options=options)
            if solved.ok:
                starts[f"DDP in the simulator ({len(starts)})"] = narrowed(setup, solved)
    found = []
    for origin, policy in starts.items():
        utility = setup.task.utility(setup.run(policy))
        _, better = polish(setup, policy)
        say(f"{setup.name}: {origin} {utility:.5g}, polished {better:.5g}")
        found += [(utility, origin), (better, f"{origin}, polished")]
    return max(found)


def narrowed(setup: Setup, solved: ddp.Result) -> Policy:
    """Return the policy of a solve in the simulator, reduced to the measured states."""
    policy, model = setup.truth.policy(solved.u, solved.K, solved.z[:-1]), setup.task.model
    angles = tuple(bool(a) for a in model.angle_mask)
    return policy.laid_out(model.state_names, angles, policy.depths)


def polish(setup: Setup, policy: Policy) -> tuple[Policy, float]:
    """Improve the feed-forward by Gauss-Newton on the robot's runs."""
    task, first = setup.task, np.array(policy.feedforward)
    span = np.where(np.isfinite(task.high - task.low), task.high - task.low, 1.0)

    def sent(w: np.ndarray) -> np.ndarray:  # w is about 1, so that relative steps are of the ranges
        return first + span * (w.reshape(first.shape) - 1.0)

    def missed(w: np.ndarray) -> np.ndarray:
        return residual(setup, policy, sent(w))

    found = least_squares(missed, np.ones(first.size), diff_step=SHIFT, ftol=GAIN, max_nfev=ROUNDS)
    better = replace(policy, feedforward=sent(found.x))
    utilities = [task.utility(setup.run(one)) for one in (policy, better)]
    return (better if utilities[1] > utilities[0] else policy), max(utilities)


def residual(setup: Setup, policy: Policy, v: np.ndarray) -> np.ndarray:
    """Return the square roots of a run's penalties: utility = -|residual|^2."""
    trial: Trial = setup.run(replace(policy, feedforward=v))
    task, reward, T = setup.task, setup.task.reward, trial.steps
    error = np.nan_to_num(task.model.difference(trial.states, task.target[: T + 1]))
    weight = np.tile(reward.state, (T + 1, 1))
    if task.horizon == T:
        weight[-1] += reward.terminal
    change = np.diff(np.vstack([task.past, trial.inputs]), axis=0)
    off = trial.inputs - task.input_target[:T]
    whole = np.full((task.horizon + 1, task.model.n + 2 * task.model.m), LOST)
    whole[: T + 1, : task.model.n] = np.sqrt(weight) * error
    whole[:T, task.model.n :] = np.hstack(
        [np.sqrt(reward.input) * off, np.sqrt(reward.input_change) * change]
    )
    if task.horizon == T:
        whole[-1, task.model.n :] = 0.0
    return whole.ravel()
