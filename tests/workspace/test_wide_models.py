"""Models of many states or inputs: an answer, or one clear refusal; never a silence."""

import numpy as np
import pytest

from facts import holding
from grounded.diagnosis.diagnose import diagnose
from grounded.errors import GroundedError
from grounded.fit import fit
from grounded.trial import Trial
from grounded_trials import Workspace

RING = """
import numpy as np
from grounded import Model, Param

N, M = {n}, {m}


def rate(s, a, p):
    x, u = [s[f"x{{i}}"] for i in range(N)], [a[f"u{{j}}"] for j in range(M)]
    return {{
        f"x{{i}}": p.k * (x[i - 1] - x[i]) - p.c * np.sin(x[i]) + sum(u[i % M :: N])
        for i in range(N)
    }}


def step(s, a, p, dt):
    x = np.array([float(s[f"x{{i}}"]) for i in range(N)])
    u = np.array([float(a[f"u{{j}}"]) for j in range(M)])
    push = np.array([u[i % M :: N].sum() for i in range(N)])
    x = x + dt * (p.k * (np.roll(x, 1) - x) - p.c * np.sin(x) + push)
    return {{f"x{{i}}": x[i] for i in range(N)}}


model = Model(
    states={{f"x{{i}}": "m" for i in range(N)}},
    inputs={{f"u{{j}}": "1" for j in range(M)}},
    params={{"k": Param(1.0, "1/s", 0.1, 3.0), "c": Param(0.5, "1/s", 0.1, 2.0)}},
    {how},
)
"""


def ring(n, m, how="derivative=rate"):
    names = {}
    exec(RING.format(n=n, m=m, how=how), names)
    return names["model"]


def logged(model, steps=60):
    rng = np.random.default_rng(1)
    u = np.cumsum(rng.standard_normal((steps, model.m)), axis=0) / 10
    x = rng.standard_normal((steps + 1, model.n))
    names = {"state_names": model.state_names, "input_names": model.input_names}
    return Trial(dt=0.05, states=x, inputs=u, **names)


@pytest.mark.parametrize("n, m", [(1000, 1), (5, 200), (101, 100)])
def test_more_than_200_names_are_refused_before_anything_is_computed(n, m, tmp_path):
    with pytest.raises(GroundedError, match=holding(f"{n} states", f"{m} inputs", "200")):
        ring(n, m)
    file = tmp_path / "ring.py"
    file.write_text(RING.format(n=n, m=m, how="derivative=rate"))
    with pytest.raises(GroundedError, match=holding("200")):
        Workspace.create(tmp_path / "w", model=file)
    assert not (tmp_path / "w").exists()


@pytest.mark.parametrize(
    ("asked", "n", "m", "facts"),
    [(fit, 51, 2, ("51 states", "50")), (diagnose, 20, 31, ("20 states", "31 inputs", "50"))],
)
def test_a_fit_and_a_diagnosis_say_how_many_names_they_take(asked, n, m, facts):
    model = ring(n, m)
    with pytest.raises(GroundedError, match=holding(*facts)):
        asked(model, [logged(model)])


@pytest.mark.slow
def test_a_wide_model_gets_a_candidate(tmp_path, n=10, m=60, how="step=step"):
    (tmp_path / "ring.py").write_text(RING.format(n=n, m=m, how=how))
    workspace = Workspace.create(tmp_path / "w", model=tmp_path / "ring.py")
    candidate = workspace.propose().candidate
    assert candidate.policy.gain.shape == (100, m, n + m)
    assert np.abs(candidate.predicted_states).max() < 1e-3  # the target is rest
