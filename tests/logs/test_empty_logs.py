"""Logs that hold nothing to use: no bytes, no numbers, or no file at all."""

import os

import pytest

from cli import grounded, plain
from facts import holds
from grounded.errors import GroundedError
from grounded_trials import Workspace
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.recover import recover_log
from workspaces import CONFIG, make


@pytest.mark.parametrize("name", ["run.mcap", "run.csv", "run.db3", "run.npz", "run.bag", "run"])
def test_a_file_without_a_byte_is_called_empty(tmp_path, name):
    log = tmp_path / name
    log.write_bytes(b"")
    with pytest.raises(GroundedError, match=r"is empty \(0 bytes\)"):
        inspect_log(log)
    with pytest.raises(GroundedError, match=r"is empty \(0 bytes\)"):
        recover_log(log, tmp_path / "out.mcap")
    assert sorted(p.name for p in tmp_path.iterdir()) == [name]


def test_a_recovered_log_is_an_mcap_file_in_a_folder_that_exists(tmp_path):
    (tmp_path / "run.mcap").write_bytes(b"x" * 100)
    for target in ("out.csv", "nix/out.mcap"):
        with pytest.raises(GroundedError, match=r"\.mcap|folder does not exist"):
            recover_log(tmp_path / "run.mcap", tmp_path / target)
        assert not (tmp_path / target).exists()


@pytest.mark.parametrize(
    ("rows", "named"),
    [(["t,mode", "0,auto", "0.1,man", "0.2,man"], "mode"), (["t", "0", "0.1", "0.2"], "times")],
)
def test_init_writes_nothing_for_a_log_without_numbers(tmp_path, rows, named):
    log = tmp_path / "run.csv"
    log.write_text("\n".join(rows) + "\n")
    done = grounded("init", tmp_path / "w", "--from", log)
    assert done.code == 1 and "holds no numbers" in plain(done.err) and named in done.err
    assert not (tmp_path / "w").exists()


def test_a_log_in_which_nothing_changes_is_refused_by_init_and_named_by_ingest(tmp_path):
    log = tmp_path / "off.csv"
    rows = [f"{0.05 * k:.2f},0.25,0,1.5" for k in range(100)]
    log.write_text("\n".join(["t,x,v,force", *rows]) + "\n")
    done = grounded("init", tmp_path / "w", "--from", log)
    assert done.code == 1 and not (tmp_path / "w").exists()
    assert holds(plain(done.err), "off.csv", "3 numbers", "switched off")
    table = "".join(f'[log.state.{n}]\npath = "/csv.{n}"\n' for n in ("x", "v"))
    table += '[log.input.force]\npath = "/csv.force"\n'
    w = Workspace(make(tmp_path / "cart", config=CONFIG + table).folder)
    (said,) = w.ingest(log, data=True).warnings
    assert holds(said, "no state changes", "discard t0001")
    log.write_text(log.read_text().replace("4.95,0.25", "4.95,0.26"))
    assert not [one for one in w.ingest(log, data=True).warnings if "no state changes" in one]


def test_a_missing_log_names_the_closest_or_the_newest_few(tmp_path):
    for k in range(9):
        path = tmp_path / f"drive{k}.mcap"
        path.write_bytes(b"x")
        os.utime(path, (1000 + k, 1000 + k))
    with pytest.raises(GroundedError, match=r"did you mean 'drive\d.mcap'"):
        inspect_log(tmp_path / "drve4.mcap")
    with pytest.raises(GroundedError, match=r"did you mean 'drive4.mcap'"):
        inspect_log(tmp_path / "drive4.cvs")
    with pytest.raises(GroundedError) as refused:
        inspect_log(tmp_path / "zzz.mcap")  # of the same ending as all others
    said = str(refused.value)
    assert "9 logs" in said and "drive8.mcap, drive7.mcap and drive6.mcap" in said
    assert "drive5" not in said
