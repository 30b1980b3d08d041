"""Whatever the user's code does, a command ends in one document or one message."""

from itertools import cycle

import pytest

from cli import process
from user_code import DEEDS, HARMLESS, PLACES
from workspaces import MODEL, make


@pytest.mark.parametrize("place", PLACES)
def test_what_a_model_prints_goes_to_stderr(tmp_path, place):
    deed = "\n".join(list(DEEDS.values())[:HARMLESS])
    make(tmp_path / "w", model=PLACES[place](MODEL, deed))
    done = process("-C", "w", "propose", "--json", cwd=tmp_path)
    assert done.code == 0 and done.json["candidate"] == "c0001"
    assert (tmp_path / "w" / "candidates" / "c0001.mcap").exists()
    assert "printed" in done.err and "written" in done.err


@pytest.mark.slow
@pytest.mark.parametrize(("deed", "place"), [*zip(list(DEEDS)[HARMLESS::2], cycle(PLACES))])
def test_whatever_a_model_raises_is_one_message(tmp_path, place, deed):
    make(tmp_path / "w", model=PLACES[place](MODEL, DEEDS[deed]))
    done = process("-C", "w", "propose", "--json", cwd=tmp_path)
    assert done.code == 1 and done.out == ""
    assert done.err.count("error: ") == 1 and "model.py" in done.err
    assert "Traceback" not in done.err
