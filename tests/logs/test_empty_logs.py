"""Logs that hold nothing to use: no bytes, no numbers, or no file at all."""

import pytest

from cli import grounded, plain
from facts import holding
from grounded.errors import GroundedError
from grounded_trials.logs.inspection.inspect_log import inspect_log
from grounded_trials.logs.recover import recover_log


@pytest.mark.parametrize("name", ["run.mcap", "run.csv", "run.db3", "run.npz", "run.bag", "run"])
def test_a_file_without_a_byte_is_called_empty(tmp_path, name):
    log = tmp_path / name
    log.write_bytes(b"")
    with pytest.raises(GroundedError, match=holding(name)):
        inspect_log(log)
    with pytest.raises(GroundedError, match=holding(name)):
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
    [(["t,mode", "0,auto", "0.1,man", "0.2,man"], "mode"), (["t", "0", "0.1", "0.2"], "run.csv")],
)
def test_init_writes_nothing_for_a_log_without_numbers(tmp_path, rows, named):
    log = tmp_path / "run.csv"
    log.write_text("\n".join(rows) + "\n")
    done = grounded("init", tmp_path / "w", "--from", log)
    assert done.code == 1 and "holds no numbers" in plain(done.err) and named in done.err
    assert not (tmp_path / "w").exists()
