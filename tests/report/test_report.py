"""grounded report: what it says, in what shape, damaged files; its viewers and extras."""

from __future__ import annotations

import re
import stat
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from cli import grounded, plain
from facts import holds
from grounded.errors import GroundedError, needs
from grounded_cli import report
from grounded_trials import Workspace
from grounded_trials.logs.signals import SignalSpec, read_signals
from grounded_trials.report.gathering import gather
from grounded_trials.report.tables import parameter_table
from grounded_trials.workspace.folder import Folder
from reported import DIAGNOSIS, copied, damage, diagnosed, stored
from workspaces import make


def test_text_fits_a_terminal_and_ends_with_the_next_command(cart, car):
    for folder, command in ((cart, "adopt viscous_friction:v"), (car, "propose")):
        done = grounded("-C", folder, "report")
        assert done.code == 0, done.err
        lines = done.out.rstrip("\n").split("\n")
        assert max(map(len, lines)) <= 80
        assert plain(done.out).split("\n")[-2] == f"next: grounded {command}"
        assert "\x1b" not in done.out


def test_json_holds_what_the_contract_says(cart):
    document = grounded("-C", cart, "report", "--json").json
    status = grounded("-C", cart, "status", "--json").json
    assert document["utilities"] == status["utilities"]
    assert document["paths"] == {}
    assert document["verdict"]["effects"] == DIAGNOSIS["verdict"]["effects"]
    assert document["best"]["candidate"] == status["best"]["candidate"]
    assert set(document["best"]["tracking_error"]) == {"x", "v"}
    assert document["best"]["tracking_error"]["v"] is None  # no target: not a number


@pytest.mark.slow
@pytest.mark.extra("view", "png")
def test_json_names_the_files_that_were_written(learnt):
    paths = grounded("-C", learnt, "report", "--html", "--rrd", "--png", "--json").json["paths"]
    files = [paths["html"], paths["rrd"], *paths["png"]]
    assert all(Path(file).stat().st_size > 1000 for file in files)
    assert {Path(p).stem for p in paths["png"]} >= {"utility", "paths", "states", "bias"}


@pytest.mark.extra("view", "png")
def test_a_workspace_without_trials_has_a_report(tmp_path):
    make(tmp_path / "w")
    done = grounded("-C", tmp_path / "w", "report", "--html", "--png", "--rrd")
    assert done.code == 0, done.err
    assert plain(grounded("-C", tmp_path / "w", "report").out).endswith("next: grounded propose\n")


@pytest.mark.extra("view", "png")
def test_a_damaged_trial_is_left_out_and_named(learnt):
    path = damage(learnt, "trials/t0002-*")
    done = grounded("-C", learnt, "report")
    assert done.code == 3
    assert path.name in done.out
    assert plain(done.out).rstrip().split("\n")[-1].startswith("next: grounded ")
    document = grounded("-C", learnt, "report", "--json", "--html", "--rrd")
    assert document.code == 3
    assert document.json["lost"][0]["file"] == path.name
    assert path.name in Path(document.json["paths"]["html"]).read_text()


@pytest.mark.extra("view", "png")
def test_all_trials_may_be_lost(learnt):
    for number, path in enumerate(sorted(learnt.glob("trials/*.mcap"))):
        path.chmod(0o644)
        path.write_bytes(b"" if number % 2 else b"\x89MCAP0\r\n nonsense")
    done = grounded("-C", learnt, "report", "--html", "--png", "--rrd")
    assert done.code == 3, done.err


def test_a_damaged_candidate_is_taken_from_the_trial_that_ran_it(learnt, cart):
    damage(learnt, "candidates/c0002.mcap")
    (learnt / "candidates" / "c0001.mcap").unlink()
    done = grounded("-C", learnt, "report", "--json")
    assert done.code == 0, done.err
    assert done.json["utilities"] == grounded("-C", cart, "report", "--json").json["utilities"]


@pytest.mark.parametrize("text", ["", "[]", '{"verdict": 3}', "\x00", "[" * 100_000])
def test_a_damaged_diagnosis_is_named(learnt, text):
    (learnt / "reports" / "diagnosis.json").write_text(text)
    done = grounded("-C", learnt, "report", "--json")
    assert done.code == 3
    (lost,) = done.json["lost"]
    assert lost["file"] == "diagnosis.json" and lost["reason"]


@pytest.mark.extra("view")
def test_the_first_trial_may_be_lost_and_a_short_one_is_shown_as_failed(cart, tmp_path):
    w = Folder(copied(cart, tmp_path / "w"))
    trial = w.trials()[-1].trial
    states = np.array(trial.states[:11])
    states[7:] = np.nan
    short = replace(trial, states=states, inputs=trial.inputs[:10])
    about = {"kind": "trial", "task": w.task.hash}
    stored(w, short, about, w.candidate_bytes(short.candidate))
    assert "failed" in grounded("-C", w.folder, "report").out
    damage(w.folder, "trials/t0001-*")
    assert grounded("-C", w.folder, "report", "--html", "--rrd").code == 3


def test_nothing_heavy_is_imported_for_text(cart):
    script = (
        "import sys; sys.argv = ['grounded', '-C', sys.argv[1], 'report']\n"
        "from grounded_cli.main import main\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "heavy = {'rerun', 'plotly', 'jinja2', 'matplotlib', 'scipy.optimize'} & set(sys.modules)\n"
        "print(heavy, file=sys.stderr); sys.exit(bool(heavy))"
    )
    done = subprocess.run([sys.executable, "-c", script, str(cart)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.extra("view", "png")
def test_a_workspace_of_data_only_shows_the_model_against_the_data(cart, tmp_path):
    folder = tmp_path / "data"
    make(folder)
    for path in sorted(cart.glob("trials/t000[12]-*")):
        assert grounded("-C", folder, "ingest", path, "--data").code == 0
    done = grounded("-C", folder, "report", "--html", "--png", "--rrd", "--json")
    assert done.code == 0, done.err
    names = ["paths", "data-t0001", "data-t0002"]
    assert [Path(p).stem for p in done.json["paths"]["png"]] == names
    shown = Path(done.json["paths"]["html"]).read_text()
    assert "t0001" in shown


@pytest.mark.extra("view", "png")
def test_a_candidate_that_was_not_run_yet_is_shown_as_predicted(tmp_path):
    make(tmp_path / "w")
    assert grounded("-C", tmp_path / "w", "propose").code == 0
    done = grounded("-C", tmp_path / "w", "report", "--html", "--rrd", "--png", "--json")
    assert done.code == 0, done.err
    assert "c0001" in Path(done.json["paths"]["html"]).read_text()
    assert plain(grounded("-C", tmp_path / "w", "report").out).endswith("next: grounded run\n")


@pytest.mark.parametrize("form", ["csv", "npz"])
def test_a_trial_that_was_exported_is_read_back(cart, tmp_path, form):
    trial, file = Workspace(cart).trials()[0].trial, tmp_path / f"run.{form}"
    assert grounded("-C", cart, "export", "t0001", "-o", file, "--json").json["format"] == form
    found = read_signals(file, {"v": SignalSpec(f"/{form}.v")})["v"]
    np.testing.assert_allclose(found.values, trial.states[:, trial.state_names.index("v")])


FRICTION = "viscous_friction:v"
ROW = {
    "horizon_s": 1.0,
    "unit_by_channel": {"x": "m", "v": "m/s"},
    "crude": {"x": 0.25, "v": 0.31},
    "with_effects": {"x": 0.012, "v": 0.02},
    "noise_floor": {"x": 0.01, "v": 0.019},
}
MADE = {"trials": ["t0001", "t0002"], "adopted": [], "params": {}, "nominal": {"mass": 1.0}}


def written(folder: Path, **more) -> Workspace:
    diagnosed(folder, **{"prediction_error": [ROW], "diagnosed": MADE} | more)
    return Workspace(folder)


def test_what_was_adopted_is_told_everywhere(learnt, cart):
    assert Workspace(cart).report().to_json()["adopted"] is None
    w = written(learnt)
    w.adopt(FRICTION)
    done = grounded("-C", learnt, "report", "--html", "--json").json["adopted"]
    assert "0.300 +- 0.010 1/s" in done["clauses"][0]
    assert done["clauses"][1] == "mass: 1.400 +- 0.020 kg, was 1"
    page = (w.reports / "report.html").read_text().replace("\xa0", " ")
    for text in (grounded("-C", learnt, "report").out, re.sub(r"<[^>]+>", "", page)):
        assert re.search(r"12\s+mm\s+instead\s+of\s+250\s+mm", text)
    made = parameter_table(gather(Folder(learnt)))
    row = dict(zip(made.header, next(r for r in made.rows if r[0] == "mass"), strict=True))
    assert (row["in model.py"], row["now"]) == ("1.000", "1.400")
    assert row["diagnosed "].startswith("1.400 +- 0.020")


DRAG = {"name": "quadratic_drag:v", "k": 0.2}
K = "quadratic_drag_v_k"
HALF = {"effect": FRICTION, "values": [FRICTION], "rests_on": {"mass": 0.1}}
ADOPTIONS = {  # a diagnosis, what is then known only jointly, and what stays behind
    "all": ({}, [], {}),
    "a parameter that the trials do not tell": (
        {"identifiable": [{"parameter": "mass", "verdict": "not identifiable"}]},
        [],
        {"mass": 1.4},
    ),
    "a parameter that its bound has cut": (
        {"parameters": {"mass": {"value": 1.4, "std": 0.5, "unit": "kg", "stopped": "bound"}}},
        [],
        {"mass": 1.4},
    ),
    "a loss that was 0, and is within its +-": (
        {
            "diagnosed": MADE | {"nominal": {"mass": 0.0}},
            "parameters": {"mass": {"value": 0.3, "std": 0.5, "unit": "kg"}},
        },
        [],
        {"mass": 0.3},
    ),
    "a parameter known with others": (
        {"identifiable": [{"parameter": "mass", "verdict": "not identifiable", "jointly": True}]},
        ["mass"],
        {},
    ),
    "an effect known with others": ({"combinations": [HALF]}, [FRICTION], {}),
    "a number of an adopted effect": (
        {
            "diagnosed": MADE | {"adopted": [DRAG], "nominal": {"mass": 1.0, K: 0.2}},
            "parameters": {K: {"value": 0.5, "std": 0.1, "unit": "1/m"}},
            "identifiable": [{"parameter": K, "verdict": "not identifiable"}],
        },
        [],
        {K: 0.5},
    ),
}


@pytest.mark.parametrize("case", ADOPTIONS)
def test_what_is_adopted_is_what_the_trials_tell(learnt, case):
    changes, jointly, left = ADOPTIONS[case]
    w = written(learnt, **changes)
    shown = grounded("-C", learnt, "adopt", FRICTION)
    assert shown.code == 0 and all(name.split("_")[0] in shown.err for name in left)
    w.undo_adoption()
    done = w.adopt(FRICTION).to_json()
    assert (done["jointly"], done["left"]) == (jointly, left)
    assert done["params"] == ({} if left else {"mass": 1.4})


needs_posix = pytest.mark.skipif(sys.platform == "win32", reason="needs a POSIX shell")


@pytest.mark.extra("view")
def test_without_a_screen_the_recording_is_written_and_named(learnt, monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    done = grounded("-C", learnt, "view")
    assert done.code == 1
    assert holds(done.err, "recording.rrd", "rerun")
    assert (learnt / "reports" / "recording.rrd").stat().st_size > 1000


@pytest.mark.slow
@needs_posix
@pytest.mark.extra("view")
@pytest.mark.parametrize(("ending", "code"), [("exit 3", 1), ("sleep 3", 0)])
def test_the_viewer_is_started_for_this_machine_alone(learnt, tmp_path, monkeypatch, ending, code):
    program = tmp_path / "rerun"
    program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/words\n{ending}\n')
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("DISPLAY", ":7")
    monkeypatch.setattr(report.sys, "executable", str(tmp_path / "python"))
    done = grounded("-C", learnt, "view")
    assert done.code == code, done.err
    assert "Traceback" not in done.err
    words = (tmp_path / "words").read_text().split()
    assert words[:3] == ["--new", "--bind", "127.0.0.1"] and words[3].endswith("recording.rrd")


PAGE = Path(__file__).resolve().parents[2] / "docs" / "foxglove.md"


needs_page = pytest.mark.skipif(not PAGE.exists(), reason="docs/ is not beside the tests")


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page's RC car, with feedback: its policy has gains."""
    folder = tmp_path_factory.mktemp("foxglove") / "car"
    make(folder, "car-circle")
    assert grounded("-C", folder, "learn", "--trials", 1).code == 0
    return folder


def _paths(text: str) -> set[str]:
    return set(re.findall(r"`(/[a-z_]+(?:\.[a-z_]+(?:\[\d+\])?)?)`", text))


def _values(path: Path) -> dict[str, object]:
    """The first message of every topic, decoded by the mcap project's own decoder."""
    pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support is not installed")
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    found: dict[str, object] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, _, decoded in reader.iter_decoded_messages():
            assert schema is not None and schema.encoding == "protobuf"
            found.setdefault(channel.topic, decoded)
            found[f"schema {channel.topic}"] = schema.name
    return found


@needs_page
def test_every_path_of_the_page_is_in_a_file(car):
    (trial,) = car.glob("trials/t0001-*")
    values = _values(trial) | _values(car / "candidates" / "c0001.mcap")
    paths = _paths(PAGE.read_text())
    assert len(paths) > 12
    for path in paths:
        topic, _, field = path.partition(".")
        assert topic in values, path
        if field:
            name, _, index = field.rstrip("]").partition("[")
            value = getattr(values[topic], name)
            if index:
                value = value[int(index)]
            assert isinstance(value, float) or (path == "/policy.gain" and len(value)), path


@needs_page
def test_the_script_of_the_page_runs(car, tmp_path):
    pytest.importorskip("mcap_protobuf", reason="mcap-protobuf-support is not installed")
    (script,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (trial,) = car.glob("trials/t0001-*")
    (tmp_path / "trial.mcap").write_bytes(trial.read_bytes())
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) > 50


@pytest.mark.parametrize(
    ("module", "words", "extra"),
    [
        ("rerun", ("report", "--rrd"), "view"),
        ("rerun", ("view",), "view"),
        ("jinja2", ("report", "--html"), "report"),
    ],
)
def test_a_command_names_the_extra_that_it_needs(tmp_path, monkeypatch, module, words, extra):
    make(tmp_path / "w")
    monkeypatch.setitem(sys.modules, module, None)
    done = grounded("-C", tmp_path / "w", *words)
    assert done.code == 1 and f"'.[{extra}]'" in done.err
    assert "Traceback" not in done.err and done.err.count("\n") == 1


def test_nothing_is_written_where_an_extra_is_missing(tmp_path, monkeypatch):
    make(tmp_path / "w")
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    done = grounded("-C", tmp_path / "w", "report", "--html", "--png")
    assert done.code == 1 and not (tmp_path / "w" / "reports" / "report.html").exists()


def test_what_is_there_is_imported():
    assert needs("json", "all") is sys.modules["json"]
    with pytest.raises(GroundedError, match=r"no_such_module.*\.\[all\]"):
        needs("no_such_module", "all")


@pytest.mark.parametrize(
    ("module", "never"),
    [
        ("grounded_trials.report.page", ("grounded.diagnosis.likelihood", "grounded.effects")),
        (
            "grounded_trials.workspace.candidates.proposing",
            ("grounded.diagnosis", "grounded.search.improve"),
        ),
        (
            "grounded.search.improve",
            ("grounded.search.first_policy",),
        ),
    ],
)
def test_a_command_imports_what_it_needs(module, never):
    code = f"import sys, {module}; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not [name for name in found.stdout.split() if name.startswith(never)]
