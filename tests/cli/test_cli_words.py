"""A whole session as a person reads it: 80 columns, one trial and two trials, the same words."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import small_tasks
from cli import grounded, process
from facts import holds
from grounded.result import listed
from grounded_cli.ingest import _tell
from grounded_trials import Workspace
from grounded_trials.workspace.intake.ingest import Ingested
from reported import cart, copied
from workspaces import CONFIG, MODEL, make

__all__ = ["cart"]


def said(done, code=0):
    """All that a command printed, checked as every output is."""
    assert done.code == code, done.err
    text = done.out + done.err
    long = [line for line in text.splitlines() if len(line) > 80]
    assert not long, long
    assert not re.search(r"(?<![\d.,])1 (trial|log|step|message|sample|file|improvement)s\b", text)
    for word in ("not accepted", "no improvement", "[1]", "of ours"):
        assert word not in text
    return text


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A new workspace, which is the current folder."""
    make(tmp_path / "w")
    monkeypatch.chdir(tmp_path / "w")
    return tmp_path / "w"


def test_a_model_that_is_not_compiled_is_named_once(here):
    (here / "model.py").write_text(
        MODEL.replace("    return", "    if s.x > 99:\n        return {}\n    return")
    )
    done = grounded("propose")  # the path of a test's folder may be longer than a line
    text = " ".join((done.out + done.err).split())
    assert text.count("not compiled") == 1 and "model.py" in text


def test_where_a_run_without_a_position_goes(here):
    """[safety] and the target say which states a person looks at; both ends are rounded alike."""
    (here / "model.py").write_text(MODEL.replace('"position": ("x",), ', ""))
    config = CONFIG.replace("force = [-5.0, 5.0]", "force = [-0.56967, 0.57636]")
    (here / "grounded.toml").write_text(config)
    text = said(grounded("propose"))
    assert re.search(r"^  x +-?\d.* to .* m$", text, re.M) and not re.search(r"^  v ", text, re.M)
    force = re.search(r"^  force +(\S+) to (\S+) N, limits -0.57 to 0.576$", text, re.M)
    assert force and float(force[2]) <= 0.576 and len(force[2].split(".")[1]) == 3
    (here / "grounded.toml").write_text(config + "[safety]\nv = [-9.0, 9.0]\n")
    text = said(grounded("propose"))
    assert re.search(r"^  x ", text, re.M) and re.search(r"^  v +.* m/s$", text, re.M)


@pytest.mark.slow
def test_a_session_from_the_first_trial_to_the_export(here):
    assert "N, limits -5 to 5" in said(grounded("propose"))
    said(grounded("run"))
    text = said(grounded("ingest", "runs/c0001-1.mcap"))
    assert re.search(r"c0001 +utility .*, first: what the search improves on", text)
    assert "best       c0001" in said(grounded("status"))
    said(grounded("learn", "--trials", 1))
    text = said(grounded("learn"))
    assert re.search(r"c0001 .* first$", text, re.M)
    assert said(grounded("status")).rstrip().endswith("next: grounded diagnose")
    text = said(grounded("diagnose"))
    assert "next: grounded " in text
    for command in ("report", "fit", "verify", "propose"):
        said(grounded(command))
    assert "grounded.policy.load" in said(grounded("export", "best", "-o", "p.npz"))
    assert Path("p.npz").read_bytes()[:2] == b"PK"


def test_the_first_trial_is_called_first(tmp_path):
    folder = make(tmp_path / "w").folder
    lines = grounded("-C", folder, "learn", "--trials", 2).err.splitlines()
    assert lines[0].endswith("  first") and lines[1].endswith("better")


def test_a_trial_that_was_no_better_is_called_so_everywhere(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    (worse,) = folder.glob("trials/t0001-*")
    shutil.copy(worse, tmp_path / "again.mcap")
    said_so = [grounded("-C", folder, command) for command in ("status", "report")]
    page = grounded("-C", folder, "report", "--html").out.splitlines()[0]
    if any("no better" in done.out for done in said_so):
        assert all("no better" in done.out for done in said_so)
        assert "no better" in Path(page).read_text()
    again = grounded("-C", folder, "ingest", tmp_path / "again.mcap")
    assert holds(again.out, "again.mcap", "t0001", "first")


def test_a_failed_first_policy_is_no_measure_of_the_gain(tmp_path):
    """Once c0001 has a failed trial, the best can't be so many per cent better than it."""
    folder = make(tmp_path / "w").folder
    assert grounded("-C", folder, "learn", "--trials", 2).code == 0
    from grounded_trials.store.trial_file import read_trial, trial_bytes
    from grounded_trials.workspace.folder import Folder

    w = Folder(folder)
    stored = w.store.list()[0]
    trial, meta, policy = read_trial(w.store.read(stored))
    about = {key: meta[key] for key in ("kind", "iteration", "alpha", "task")}
    short = trial.until(5)
    (tmp_path / "short.mcap").write_bytes(trial_bytes(short, about, policy))
    done = grounded("-C", folder, "ingest", tmp_path / "short.mcap")
    assert done.code == 0, done.err
    assert re.search(r"no +utility, +crashed\b", done.out)
    (best,) = re.findall("^best .*(?:\n .*)*", said(grounded("-C", folder, "status")), re.M)
    assert "failed" in best and "%" not in best


def test_a_unit_of_one_is_not_printed(tmp_path):
    model = MODEL.replace('"force": "N"', '"force": "1"').replace('1.0, "kg"', '1.0, "1"')
    folder = make(tmp_path / "w", model=model).folder
    assert re.search(r"force +-?[\d.]+ to [\d.]+, limits", grounded("-C", folder, "propose").out)
    grounded("-C", folder, "learn")
    fitted = grounded("-C", folder, "fit").out
    assert re.search(r"^mass .*\d\.\d+$", fitted, re.M), fitted
    page = Path(grounded("-C", folder, "report", "--html").out.splitlines()[0]).read_text()
    assert "force [1]" not in page and "<td>1</td><td>0.01" not in page
    exported = grounded("-C", folder, "export", "best", "--json").json["file"]
    assert '"force": "1"' in Path(exported).read_text().replace("'", '"')
    Path(exported).unlink()


def test_repeats_say_what_is_waited_for(tmp_path):
    folder = make(tmp_path / "w", config=CONFIG.replace("[search]", "[search]\nrepeats = 2")).folder
    grounded("-C", folder, "propose")
    path = grounded("-C", folder, "run", "--json").json["trial_file"]
    taken = grounded("-C", folder, "ingest", path, "--json").json["trials"]
    assert taken[0]["verdict"] == "waiting"
    assert holds(grounded("-C", folder, "propose").out, "c0001", "1 trial")
    path = grounded("-C", folder, "run", "--json").json["trial_file"]
    assert grounded("-C", folder, "ingest", path, "--json").json["trials"][0]["verdict"] == "first"


# mistakes


@pytest.mark.parametrize(
    ("words", "holds"),
    [
        (["status", "-C", "grounded.toml"], "is a file: -C takes the folder"),
        (["ingest", "."], "is a workspace: give the log"),
        (["ingest", "model.py"], "model.py is not a log"),
        (["adopt", "x:y"], "nothing was diagnosed yet"),
        (["diagnose", "--trials", "t9,"], "there is no trial to learn from"),
        (["diagnose", "--without", "delay,delai"], "did you mean 'delay'"),
        (["diagnose", "--trials", ""], "--trials names no trial: expected some, like t0001"),
        (["fit", "--params", ","], "--params names no parameter: expected names such as a1,L"),
        (["diagnose", "--trials", " , "], "omit it to use all"),
        (["recover", "trials"], "is a folder"),
        (["recover", "model.py"], "look for another copy of the recording"),
        (["ingest", "nofile.mcap"], "nofile.mcap does not exist"),
        (["ingest", "no/nofile.mcap"], "nor does its folder no: give a path"),
        (["inspect", "nowhere.mcap"], "does not exist"),
    ],
)
def test_a_mistake_is_named(here, words, holds):
    done = grounded(*words)
    assert done.code == 1 and holds in done.err and "Errno" not in done.err, done.err


def test_a_file_says_its_format_and_must_not_contradict(here):
    done = process("export", "best", "--format", "csv", "-o", "x.npz", cwd=here)
    assert done.code == 2 and holds(done.err, "x.npz", "--format", "csv")


def test_a_document_says_the_same_words(cart):
    history = grounded("-C", cart, "status", "--json").json["history"]
    shown = grounded("-C", cart, "status").out.splitlines()[1 : len(history) + 1]
    for entry, line in zip(history, shown, strict=True):
        assert line.startswith(entry["candidate"]) and line.endswith(entry["verdict"])


def test_the_best_one_is_run_again_by_that_name(cart, tmp_path):
    folder = copied(cart, tmp_path / "w")
    best = grounded("-C", folder, "status", "--json").json["best"]["candidate"]
    done = grounded("-C", folder, "run", "best", "--json").json
    assert done["candidate"] == best
    out = grounded("-C", folder, "ingest", done["trial_file"]).out
    assert re.search(rf"^ +{best} +utility .*run again\b", out, re.M)
    empty = make(tmp_path / "empty").folder
    refused = grounded("-C", empty, "run", "best")
    assert refused.code == 1 and holds(refused.err, "best")


def test_a_rerun_says_who_is_best_now_where_it_is_another(capsys):
    """A car's next step went out from c0003 after c0001 was run again, without a word."""
    one = Ingested("t0009", "", False, "c0001", -0.1273, None, (), (), verdict="run again")
    made = SimpleNamespace(id="c0003")
    best = SimpleNamespace(candidate=made, utility=-0.1143, verdict=lambda: "maybe better")
    _tell("q5", one, best, small_tasks.cart)
    said = capsys.readouterr().out
    assert re.search(r"best is now c0003,\s+-0\.1143", said) and "perhaps by luck" in said
    best.verdict = lambda: "better"
    _tell("q5", one, best, small_tasks.cart)
    assert "luck" not in capsys.readouterr().out
    _tell("q5", replace(one, candidate="c0003"), best, small_tasks.cart)
    assert "best" not in capsys.readouterr().out


def test_a_log_that_was_stored_before_is_not_the_best_of_today(cart, tmp_path):
    """`ingest` of the second of eight runs again said "better: the best so far"."""
    from grounded_cli.ingest import BEST

    folder = copied(cart, tmp_path / "w")
    now = grounded("-C", folder, "status", "--json").json
    best, tried = now["best"]["candidate"], now["history"]
    older = [one for one in tried if one["verdict"] in BEST and one["candidate"] != best]
    files = {one.trial.candidate: one.stored.path for one in Workspace(folder).trials()}
    assert older
    for name in (older[0]["candidate"], best):
        out = grounded("-C", folder, "ingest", files[name]).out
        assert ("best so far" in out, f"best is now {best}" in " ".join(out.split())) == (
            (True, False) if name == best else (False, True)
        )


def test_a_range_is_rounded_to_what_a_person_measures():
    from grounded_cli.propose import _span

    assert _span(-3.46e-17, 2e-17) == "0"
    assert _span(-3.46e-17, 0.5) == "0.000 to 0.500"
    assert _span(0.0, 4.2e-5) == "0.000000 to 0.000042"
    assert _span(0.0, 12.0) == "0.00 to 12.00"


def test_names_are_listed_as_a_sentence_has_them():
    told = [listed(some) for some in ((), ("a",), "ab", "abc")]
    assert told == ["", "a", "a and b", "a, b and c"]
