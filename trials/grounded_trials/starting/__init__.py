"""Creates workspaces from a log, from a model alone or from an example, and draws targets.

Read `begin.py` first: it creates a workspace from a log. `kinds.py` guesses the kind of robot from
a log and chooses a model skeleton; `shapes.py` draws targets: lines, circles, figure-8s, steps,
and `drawing.py` reads one from a run. `blank.py` creates a workspace from a model alone,
`examples.py` the examples that come with grounded; `first_toml.py` writes the grounded.toml of a
log's workspace, `examples.py` all others. `templates/` has the texts of these files.
"""

from importlib.resources import files


def template(name: str) -> str:
    """Return the text of a file in `templates/`."""
    return files(__package__).joinpath("templates", f"{name}.txt").read_text("utf-8")
