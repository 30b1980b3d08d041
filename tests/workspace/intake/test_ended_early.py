"""A log that ends before the run does: cut off by the recorder, or by a crash."""

from cli import grounded
from facts import holds, of_code
from grounded_trials import Workspace
from recorded import LOGGED, record
from workspaces import make


def waiting(folder):
    w = Workspace(make(folder / "w", config=LOGGED).folder)
    return w, w.propose().candidate.policy


def test_a_log_that_is_cut_off_is_told_from_a_crash(tmp_path, until=1.3):
    w, policy = waiting(tmp_path)
    log = record(w, tmp_path / "a.csv", policy, 0.7, until=until)
    out = grounded("-C", w.folder, "ingest", log)
    told = " ".join(f"{out.out} {out.err}".split())
    assert holds(told, "no utility", "ended early") and "crashed:" not in told
    assert f"`grounded -C {w.folder} discard t0001`" in told
    now = w.forget().status()
    assert now.then.arguments == ("t0001",) and holds(now.notes[0], "t0001", "recording")
    told = grounded("-C", w.folder, "status").out
    assert holds(told, "ended early", "waiting", "discard t0001") and "crashed" not in told
    report = grounded("-C", w.folder, "report").out
    assert holds(report, "ended early", "waiting") and report.split()[-2:] == told.split()[-2:]
    assert w.propose().candidate.id == "c0002"  # it counts as failed, if the user goes on
    assert w.status().then.verb != "discard"


def test_a_state_without_values_in_a_log_that_goes_on_is_named(tmp_path):
    w, policy = waiting(tmp_path)
    log = record(w, tmp_path / "a.csv", policy, 0.7)
    header, *rows = log.read_text().splitlines()
    x, cut = header.split(",").index("x"), round(len(rows) * 0.55)
    lost = [row.split(",") for row in rows[cut:]]
    for row in lost:
        row[x] = ""
    log.write_text("\n".join([header, *rows[:cut], *(",".join(row) for row in lost)]) + "\n")
    found = w.ingest(log)
    (told,) = of_code(found, "run.early", "run.failed")
    assert told.facts["silent"] == ("x",) and not of_code(found, "log.short")
