"""grounded.toml: every wrong key is one sentence with the file, the key and the nearest name."""

import itertools
import json
import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from facts import holding
from grounded.errors import GroundedError
from grounded.search.step_size import SearchOptions
from grounded_trials.logs.log_table import log_mapping
from grounded_trials.toml_table import Table
from grounded_trials.workspace.candidates.running import simulated_plant
from grounded_trials.workspace.folder import Folder
from grounded_trials.workspace.intake.opening.estimating import EstimateTable, read_estimate
from grounded_trials.workspace.user_files.config import (
    ModelTable,
    SystemTable,
    TaskTable,
    read_config,
)
from workspaces import CONFIG, make

REFERENCE = Path(__file__).resolve().parents[3] / "docs" / "configuration.md"


@pytest.mark.parametrize(
    "table", [ModelTable, TaskTable, SearchOptions, SystemTable, EstimateTable]
)
def test_the_reference_lists_every_key_with_its_default(table):
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \|", REFERENCE.read_text(), re.M)
    listed = dict(rows)
    for key in fields(table):
        assert key.name in listed, f"docs/configuration.md does not say what {key.name} is"
        if table is SearchOptions:
            default = key.default
            shown = listed[key.name].strip("`")
            assert shown == (
                json.dumps(default) if isinstance(default, str | bool) else f"{default:g}"
            )


LOG = """
[log]
clock = "header"
[log.state.x]
path = "/odom.x"
unwrap = true
scale = 1.0
offset = 0.0
delay_s = 0.01
max_age_s = 0.2
resample = "linear"
[log.input.force]
path = "/cmd.f"
clock = "log"
[log.span]
start = { path = "/safety.data", above = 0 }
end = 5.0
[estimate]
measured = { x = 0.002 }
process = { v = 0.1 }
"""


def everything(workspace):
    """All that a command may take from grounded.toml."""
    config, model, task = workspace.config, workspace.base_model, workspace.task
    log_mapping(config.log, model.state_names, model.input_names)
    if config.estimate.values:
        read_estimate(config.estimate, model)
    if config.system.model:
        simulated_plant(workspace)
    return task


@pytest.fixture
def with_config(tmp_path):
    counter = itertools.count()

    def made(text):
        return make(tmp_path / f"w{next(counter)}", config=text)

    return made


def test_the_contracts_own_example_is_valid(with_config):
    text = (
        CONFIG.replace("[task]", "params = { mass = 1.2 }\neffects = []\n[task]")
        .replace(
            "[reward]", "feedback = true\nstart = { v = 0.0 }\nlatency = { force = 0.1 }\n[reward]"
        )
        .replace("[limits]", "terminal = { }\n[limits]")
        .replace("[search]", "[safety]\nx = [-1.5, 1.5]\n[search]")
        .replace(
            "max_trials = 12",
            'method = "ddp"\nstep = "damped"\nrefit = false\nmax_halvings = 6\nrepeats = 1\n'
            "max_trials = 40\ntolerance = 0.001",
        )
        .replace(
            'model = "real.py"', 'model = "real.py"\nseed = 0\nnoise = { start = { x = 0.01 } }'
        )
    )
    task = everything(with_config(text + LOG))
    assert task.latency.tolist() == [0.1] and task.model.values[0] == 1.2
    assert task.safety_high.tolist()[0] == 1.5


# what is replaced | by what | what the message names
WRONG = r"""
[task] | [tasks] | 'task'
[task] | surprise = 1\n[task] | [model] surprise
file = "model.py" | fil = "model.py" | [model] fil, 'file'
file = "model.py" | file = 3 | [model] file
file = "model.py" |  | [model] file
file = "model.py" | file = "model.py"\nmodule = "a.b" | [model]
file = "model.py" | module = "no_such_thing" | [model] module
file = "model.py" | file = "modle.py" | modle.py
file = "model.py" | file = "../other.py" | ../other.py
[task] | params = { mas = 1.0 }\n[task] | [model] params, 'mass'
[task] | params = { mass = "1" }\n[task] | [model.params] mass
[task] | effects = [3]\n[task] | [model] effects
[task] | smoothing = -1\n[task] | [model] smoothing
dt = 0.05 |  | [task] dt
dt = 0.05 | dt = 0 | [task] dt
dt = 0.05 | dt = 0.06 | 0.06 s, [task] dt = 0.05
dt = 0.05 | DT = 0.05 | [task] DT, 'dt'
horizon = 40 | horizon = 0 | [task] horizon
horizon = 40 | horizon = 50 | target.csv
target = "target.csv" | target = "t.csv" | t.csv, [task] target
target = "target.csv" | target = "/etc/passwd" | inside the workspace
horizon = 40 | horizon = 40\nfeedback = 1 | [task] feedback
horizon = 40 | horizon = 40\nstart = { vv = 0 } | [task] start, 'v'
horizon = 40 | horizon = 40\nlatency = { forc = 0.1 } | [task] latency, 'force'
horizon = 40 | horizon = 40\nlatency = { force = 9 } | [task] latency of force
state = { x = 10.0 } | state = { y = 10.0 } | [reward.state] y
state = { x = 10.0 } | state = { v = 1 } | [reward], v
state = { x = 10.0 } | state = { x = -1 } | [reward] state
state = { x = 10.0 } | state = { x = 0 } | reward
force = [-5.0, 5.0] | forc = [-5, 5] | [limits] forc, 'force'
force = [-5.0, 5.0] | force = [5, -5] | [limits] force
[search] | [safety]\nz = [0, 1]\n[search] | [safety] z
max_trials = 12 | max_trial = 12 | [search] max_trial, 'max_trials'
max_trials = 12 | method = "dpp" | [search] method, 'ddp'
max_trials = 12 | max_halvings = 99 | [search] max_halvings
model = "real.py" | model = "reel.py" | reel.py, [system]
model = "real.py" | model = "real.py"\ncommand = "x" | [system] command
model = "real.py" | model = "real.py"\nseed = -1 | [system] seed
model = "real.py" | model = "real.py"\nnoise = { start = { xx = 1 } } | [system.noise.start], 'x'
model = "real.py" | model = "real.py"\nnoise = { start = { x = -1 } } | [system.noise.start] x
clock = "header" | clock = "haeder" | [log] clock, 'header'
[log.state.x] | [log.state.xx] | [log.state] xx, 'x'
path = "/odom.x" |  | [log.state.x] path
path = "/odom.x" | path = "/odom.x[" | [log.state.x] path
scale = 1.0 | scael = 1.0 | [log.state.x] scael, 'scale'
scale = 1.0 | scale = 0.0 | [log.state.x] scale
delay_s = 0.01 | delay_s = inf | [log.state.x] delay_s
max_age_s = 0.2 | max_age_s = 0 | [log.state.x] max_age_s
resample = "linear" | resample = "cubic" | [log.state.x] resample
[log.input.force] | [log.input.farce] | [log.input] farce, 'force'
end = 5.0 | end = "first-input" | [log.span] end
end = 5.0 | ende = 5.0 | [log.span] ende, 'end'
above = 0 } | abov = 0 } | [log.span.start] abov, 'above'
, above = 0 } |  } | [log.span] start
measured = { x = 0.002 } | measured = { xx = 1 } | [estimate.measured] xx, 'x'
measured = { x = 0.002 } | mesured = { x = 1 } | [estimate]
process = { v = 0.1 } | process = { v = -1 } | [estimate] process.v
"""


@pytest.mark.parametrize("row", WRONG.split("\n")[1:-1])
def test_what_is_wrong_is_one_sentence_that_names_it(with_config, row):
    old, new, parts = (part.strip().replace("\\n", "\n") for part in row.split("|"))
    assert old in CONFIG + LOG
    workspace = with_config((CONFIG + LOG).replace(old, new, 1))
    with pytest.raises(GroundedError) as caught:
        everything(workspace)
    message = str(caught.value)
    assert all(part in message for part in parts.split(", ")), message
    assert "\n" not in message.strip() and len(message) < 400
    assert any(name in message for name in ("grounded.toml", "target", ".py")), message


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[model\n", "grounded.toml"),
        ("[task]\ndt = 0.05\ndt = 0.1\n", "grounded.toml"),
        ("", "[model] file"),
        ("model = 3", "model"),
        ("[modle]\nfile = 'model.py'", "'model'"),
        ("\ufeff[model]", "grounded.toml"),
    ],
    ids=["cut", "twice", "empty", "no table", "typo", "bom"],
)
def test_a_file_that_is_not_toml_or_not_ours(with_config, text, named):
    with pytest.raises(GroundedError, match=holding(named)):
        everything(with_config(text))


def test_a_folder_that_is_no_workspace(tmp_path):
    with pytest.raises(GroundedError, match=holding(tmp_path)) as refused:
        _ = Folder(tmp_path).config
    assert refused.value.then is not None and refused.value.then.verb == "init"
    (tmp_path / "grounded.toml").mkdir()
    with pytest.raises(GroundedError, match=holding(tmp_path / "grounded.toml")):
        _ = Folder(tmp_path).config
    (tmp_path / "x").mkdir()
    (tmp_path / "x" / "grounded.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(GroundedError, match=holding(tmp_path / "x" / "grounded.toml")):
        _ = Folder(tmp_path / "x").config


SCALARS = st.one_of(
    st.booleans(),
    st.integers(-(10**320), 10**320),
    st.integers(-3, 3),
    st.floats(),
    st.text(max_size=8),
    st.dates(),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: (
        st.lists(inner, max_size=3)
        | st.dictionaries(
            st.sampled_from(["x", "v", "force", "name", "path", "start"]), inner, max_size=3
        )
    ),
    max_leaves=6,
)


def keys_of(table, at=()):
    for key, value in table.items():
        yield (*at, key)
        if isinstance(value, dict):
            yield from keys_of(value, (*at, key))


def changed(table, at, value):
    copy = dict(table)
    if len(at) == 1:
        copy[at[0]] = value
    else:
        copy[at[0]] = changed(copy[at[0]], at[1:], value)
    return copy


GOOD = tomllib.loads(CONFIG + LOG)


@pytest.mark.slow
@given(st.sampled_from(sorted(keys_of(GOOD))), VALUES)
@settings(max_examples=60, deadline=None)
def test_any_value_at_any_key_is_valid_or_one_sentence(tmp_path_factory, at, value):
    from grounded_trials.workspace.user_files import config as module

    folder = tmp_path_factory.getbasetemp() / "garbage"
    if not folder.exists():
        make(folder)
    table = changed(GOOD, at, value)
    before = module.read_toml
    module.read_toml = lambda path: Table(table, path)
    try:
        everything(Folder(folder))
    except GroundedError as error:
        assert str(error)
    finally:
        module.read_toml = before


@given(st.text(max_size=200))
@settings(max_examples=80, deadline=None)
def test_any_text_is_valid_or_one_sentence(tmp_path_factory, text):
    folder = tmp_path_factory.getbasetemp() / "text"
    folder.mkdir(exist_ok=True)
    (folder / "grounded.toml").write_text(text, encoding="utf-8", errors="replace")
    with pytest.raises(GroundedError):
        read_config(folder)


@pytest.mark.parametrize(
    ("effect", "facts"),
    [
        ('"delay:force"', ("'d'",)),
        ('"delay:force", d = 0.02, dd = 3.0', ("'dd'", "'d'")),
        ('"delay:force", d = -0.02', ("-0.02", "0")),
        ('"delay:force", d = nan', ("d", "finite")),
        ('"input_gain:force", g = 9.0', ("9", "-3", "5")),
    ],
)
def test_an_adopted_effect_is_whole_and_possible(with_config, effect, facts):
    text = CONFIG.replace("[task]", f"effects = [{{ name = {effect} }}]\n[task]")
    with pytest.raises(GroundedError, match=holding("grounded.toml", "effects", *facts)):
        _ = with_config(text).planner


def test_bounds_that_the_data_chose_are_none(with_config):
    big = "[{ name = 'dead_zone:force', c = 3.0 }, { name = 'delay:force', d = 1.5 }]"
    text = CONFIG.replace("[task]", f"effects = {big}\n[task]")
    assert with_config(text).planner.plan.latency[0] == 1.5
