"""verify proves the whole workspace, and folders that lead out of it are refused."""

import pytest

from cli import grounded
from grounded.errors import GroundedError
from grounded_trials import Workspace
from workspaces import make


def searched(folder):
    make(folder)
    w = Workspace(folder)
    for _ in range(2):
        w.propose()
        w.ingest(w.run().trial_file)
    w.propose()
    return w


def test_a_trial_that_candidates_were_made_from_and_that_is_gone_is_damage(tmp_path):
    w = searched(tmp_path / "w")
    last = sorted(p for p in (tmp_path / "w" / "trials").glob("t*.mcap"))[-1]
    assert w.verify().damaged == ()
    last.unlink()
    for note in (tmp_path / "w" / "trials").glob("n*.json"):
        note.unlink()  # nothing else tells of it
    found = Workspace(tmp_path / "w").verify().damaged
    assert any("t0002" in one.reason for one in found)
    assert grounded("-C", tmp_path / "w", "verify").code != 0


@pytest.mark.parametrize("name", ["trials", "candidates", "runs", "reports"])
def test_a_folder_that_is_a_link_out_of_the_workspace_is_refused(tmp_path, name):
    make(tmp_path / "w")
    away, place = tmp_path / "elsewhere", tmp_path / "w" / name
    away.mkdir()
    if place.exists():
        place.rmdir()
    place.symlink_to(away)
    with pytest.raises(GroundedError, match=name):
        Workspace(tmp_path / "w").propose()
    assert not any(away.iterdir())


def test_a_config_with_a_byte_order_mark_is_read(tmp_path):
    make(tmp_path / "w")
    config = tmp_path / "w" / "grounded.toml"
    config.write_bytes(b"\xef\xbb\xbf" + config.read_bytes())
    assert Workspace(tmp_path / "w").status().to_json()["phase"] == "propose"


def test_temporary_files_of_a_killed_init_are_removed(tmp_path):
    left = tmp_path / "w" / f".model.py-{'0' * 16}.tmp"
    left.parent.mkdir()
    left.write_text("half")
    Workspace.create(tmp_path / "w", example="pendulum")
    assert not left.exists()
