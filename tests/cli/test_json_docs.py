"""docs/json.md names every key that a command's JSON document holds."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from cli import grounded
from reported import copied

PAGE = Path(__file__).resolve().parents[2] / "docs" / "json.md"


def documented(command):
    """The keys of the section that names a command."""
    for part in re.split(r"^## ", PAGE.read_text(), flags=re.M)[1:]:
        title, _, text = part.partition("\n")
        if command in title.split(", "):
            return re.findall(r"`([^`]+)`", "\n".join(re.findall(r"^\| (`.*?) \|", text, re.M)))
    raise AssertionError(f"docs/json.md has no section for {command}")


def unknown(command, document):
    """Paths of a document that the page does not name; what is empty has longer ones elsewhere."""
    keys = documented(command)
    known = [re.compile(_pattern(key) + r"(\[\])?(\.|$)") for key in keys]
    found = set(leaves(document))
    assert len(found) > 1
    return [p for p in found if not any(k.match(p) for k in known) and not _begun(p, keys)]


def _begun(path, keys):
    return any(key.startswith((f"{path}.", f"{path}[]")) for key in keys)


def _pattern(key):
    return re.escape(key).replace(r"\*", r"[^.]+").replace(r"\[\]", r"(\[\])?")


def leaves(value, at=""):
    """The paths of all numbers and texts: `where.channels[].rms`."""
    if isinstance(value, dict) and value:
        for key, item in value.items():
            yield from leaves(item, f"{at}.{key}".lstrip("."))
    elif isinstance(value, list) and value:
        for item in value:
            yield from leaves(item, at if isinstance(item, str | list) else f"{at}[]")
    else:
        yield at


LOG = "t,theta,omega,torque\n" + "".join(
    f"{k / 50:.3f},{np.sin(k / 9):.5f},{50 / 9 * np.cos(k / 9):.5f},{np.sign(k % 40 - 20)}\n"
    for k in range(200)
)
COMMANDS = [
    ("status",),
    ("report", "--html"),
    ("fit",),
    ("verify",),
    ("propose",),
    ("excite", "--seconds", "3"),
    pytest.param(("diagnose",), marks=pytest.mark.slow),
    ("discard", "t0002"),
    ("export", "best", "-o", "{folder}/best.npz", "--runner"),
    ("adopt", "viscous_friction:v"),
    ("export", "--model", "-o", "{folder}/found.py"),
    ("inspect", "{trial}"),
    ("ingest", "{trial}"),
    ("run", "best"),
    ("learn", "--trials", "1"),
    ("restore", "t0001"),
    ("target", "line", "--to", "x=1"),
    ("init", "{folder}/more", "--example", "pendulum"),
    ("init", "{folder}/more", "--from", "{log}"),
    ("init", "--list"),
    ("recover", "{trial}", "-o", "{folder}/saved.mcap"),
    ("explain", "log.unit"),
    ("init", "{folder}/more", "--blank", "--model", "{folder}/model.py"),
    ("next", "{trial}"),
]


@pytest.mark.parametrize("words", COMMANDS)
def test_every_key_is_documented(cart, tmp_path, words):
    folder = copied(cart, tmp_path / "w")
    trial = next((folder / "trials").glob("t0001*"))
    (log := tmp_path / "log.csv").write_text(LOG)
    fits(folder, [word.format(folder=folder, trial=trial, log=log) for word in words])


def test_what_follows_an_adoption_is_documented(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    assert grounded("-C", folder, "adopt", "viscous_friction:v").code == 0
    fits(folder, ["export", "--library", tmp_path / "actuator.yaml"])
    fits(folder, ["adopt", "--undo"])


def fits(folder, words):
    """Check that the page names the keys of a command's document."""
    done = grounded("-C", folder, *words, "--json")
    assert done.code == 0, done.err
    assert not unknown(words[0], done.json)


def test_a_key_that_is_not_there_is_found():
    assert not unknown("fit", {"params": {"mass": {"value": 1.0, "std": 0.1}}})
    assert unknown("fit", {"params": {"mass": {"valu": 1.0, "std": 0.1}}}) == ["params.mass.valu"]
    assert list(leaves(json.loads('{"a": [{"b": 1}], "c": {}}'))) == ["a[].b", "c"]
