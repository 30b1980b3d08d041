"""The figure of a candidate: the predicted states and inputs over time, in their units."""

from grounded.search.ask_tell import Search
from grounded_trials import Workspace
from workspaces import make


def test_every_axis_has_its_unit_in_memory_and_from_the_file(tmp_path):
    w = Workspace(make(tmp_path / "w").folder)
    made = Search(w.task).ask()
    assert made is not None
    for candidate in (made, w.propose().candidate, Workspace(w.folder).candidate("c0001")[0]):
        (figure,) = candidate.figures()
        named = [(panel.title, panel.x_name, panel.y_name) for panel in figure.panels]
        units = (("x", "m"), ("v", "m/s"), ("force", "N"))
        assert named == [(f"{name} [{unit}]", "time [s]", unit) for name, unit in units]


def test_an_input_without_a_unit_has_none(tmp_path):
    w = Workspace.create(tmp_path / "w", example="car-turn")
    (figure,) = w.propose().candidate.figures()
    (steering,) = [panel for panel in figure.panels if panel.title.startswith("steering")]
    assert (steering.title, steering.y_name) == ("steering", "")
