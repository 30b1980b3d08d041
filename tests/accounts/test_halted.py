"""A robot that stands still under commands that had moved it before: against a wall, or off."""

import numpy as np
import pytest

from grounded import Model, Trial
from grounded.accounts.halted import halted
from grounded.accounts.sound_trials import sound_trials as preflight
from grounded_trials import Workspace
from tests.workspace.intake.recognising.test_mistaken_logs import CONFIG, MODEL, TARGET
from workspaces import make

CART = Model(
    states={"x": "m", "v": "m/s"},
    inputs={"u": "1"},
    derivative=lambda s, a, p: {"x": s.v, "v": 2 * a.u - 3 * s.v},
)
DT, STEPS = 0.05, 600


def driven(sent, wall=np.inf, zone=0.0, hold=False):
    """Run the cart; behind `wall` it stands, below `zone` nothing moves it, `hold`: a servo."""
    rng, x, rows = np.random.default_rng(0), np.zeros(2), []
    for u in sent:
        rows.append(x)
        got = np.sign(u) * max(abs(u) - zone, 0.0)
        if hold:
            x = np.array([x[0] + 0.3 * (u - x[0]), (u - x[0]) * 0.3 / DT])
            continue
        x = CART.system.step(x[None], np.array([[got]]), CART.values, DT)[0]
        if x[0] > wall and got > -0.1:
            x = np.array([wall, 0.0])
    states = np.array([*rows, x]) + rng.normal(0, (1e-3, 4e-3), (len(sent) + 1, 2))
    return Trial(states, np.array(sent)[:, None], DT, CART.state_names, CART.input_names)


def wave(rest=60):
    """Commands that begin after a rest: gentle, then a drive to one side."""
    t = DT * np.arange(STEPS)
    return np.concatenate([np.zeros(rest), (0.45 + 0.25 * np.sin(1.3 * t))[: STEPS - rest]])


@pytest.mark.parametrize(
    "trial",
    [
        driven(wave()),
        driven(np.where(wave() > 0.55, wave(), 0.3 * wave()), zone=0.4),  # less than its dead zone
        driven(np.repeat([0.0, 0.5, 0.2, 0.6], 150), hold=True),  # poses that are held
        driven(np.repeat([0.0, 0.5, 0.0, -0.4, 0.0], 120)),
        driven(wave()[:70]),
    ],
    ids=["free", "dead zone", "servo", "rests", "short"],
)
def test_rest_that_commands_explain_is_none(trial):
    assert halted(CART, trial) is None


def test_ingest_of_data_says_where_to_cut_the_log(tmp_path):
    w = Workspace(make(tmp_path / "w", config=CONFIG, model=MODEL, target=TARGET).folder)
    rng, sent = np.random.default_rng(1), np.zeros((400, 2))
    sent[40:] = 0.5 + 0.3 * np.sin(0.05 * np.arange(360))[:, None]
    x = [np.zeros(3)]
    for k, u in enumerate(sent):
        x.append(w.base_model.system.step(x[-1][None], u[None], w.base_model.values, 0.05)[0])
        if k > 200:
            x[-1] = np.array([0.0, 0.0, x[-1][2]])
    rows = np.column_stack(
        [0.05 * np.arange(400), np.array(x)[:-1] + rng.normal(0, 2e-3, (400, 3)), sent]
    )
    path = tmp_path / "a.csv"
    np.savetxt(path, rows, "%.6f", ",", header="t,v,r,psi,port,starboard", comments="")
    told = [one for one in w.ingest(path, data=True).warnings if "nothing moves from" in one]
    assert len(told) == 1 and "[log.span] end" in told[0] and "discard t0001" in told[0]


def test_wheels_at_a_wall_are_no_sensor_that_sticks():
    rover = Model(
        states={"x": "m", "psi": "rad", "v": "m/s"},
        inputs={"u": "1", "turn": "rad/s"},
        derivative=lambda s, a, p: {
            "x": s.v * np.cos(s.psi),
            "psi": a.turn,
            "v": 2 * a.u - 3 * s.v,
        },
        angles=("psi",),
    )
    cart, rng = driven(wave(), wall=4.0), np.random.default_rng(1)
    v = np.where(abs(cart.states[:, 1]) > 0.02, cart.states[:, 1], 0.0)
    v[cart.states[:, 0] > 3.99] = 0.0
    v[-100:-97] = 0.3  # it slips once
    psi = rng.normal(0, 2e-3, len(v))
    x = np.column_stack([cart.states[:, 0], psi, v])
    u = np.hstack([cart.inputs, 0 * cart.inputs])

    def stuck(states):
        trial = Trial(states, u, DT, rover.state_names, rover.input_names)
        return [one.signal for one in preflight(rover, [trial]).findings if one.kind == "stuck"]

    assert "v" not in stuck(x)
    moving = np.column_stack([np.linspace(0, 6, len(v)), psi, v])
    assert "v" in stuck(moving)  # the camera sees it move on
