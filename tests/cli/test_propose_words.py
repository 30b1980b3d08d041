"""What `propose` says of earlier predictions is the number of the column `predicted`."""

from types import SimpleNamespace

from grounded.search.candidate import Tried
from grounded_cli.propose import _came_true


def test_a_prediction_has_one_value_and_the_noise_of_its_log_is_named():
    """-0.01340 and -0.01330 were both called the last prediction."""
    made = SimpleNamespace(id="c0001", grounded=False, predicted_utility=-0.0133)
    run = SimpleNamespace(id="t0001")
    tried = Tried(made, (run,), (-0.02,), True, noise_cost=1e-4)
    said = _came_true(made, [tried], SimpleNamespace(incumbent=None, history=(tried,)))
    assert said.index("-0.01330") < said.index("or -0.01340 with the sensor noise seen since")
    twice = _came_true(made, [tried, tried], SimpleNamespace(incumbent=None, history=(tried,)))
    assert "with sensor noise, missed the utility by 0.0066" in twice
