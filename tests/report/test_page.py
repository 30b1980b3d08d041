"""The page: complete, alone, small, safe from names and from numbers without a picture."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from grounded.diagnosis.parts import Diagnosis
from grounded.errors import NextCommand
from grounded.findings import found
from grounded_cli.report import report_text
from grounded_trials.report.figures.png import png
from grounded_trials.report.figures.runs import all_figures, error_figure, state_figure
from grounded_trials.report.findings import ESTIMATED
from grounded_trials.report.forecast import forecast_figures
from grounded_trials.report.gathering import RUNAWAY, gather
from grounded_trials.report.page import page
from grounded_trials.store.store import Lost
from grounded_trials.workspace.folder import Folder
from pace import slowness
from page_browser import unpacked
from reported import DIAGNOSIS, gathered, many_flights

EVIL = '<img src=x onerror="window.hacked=1"></script><script>window.hacked=2</script>\'&'


class _Tags(HTMLParser):
    """Notes every tag, and those that were not closed in order."""

    void = ("meta", "link", "br", "img", "input", "hr")

    def __init__(self) -> None:
        super().__init__()
        self.open, self.wrong, self.seen = [], [], []
        self.text: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))
        if tag not in self.void:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.seen.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)

    def handle_data(self, data):
        self.text.append(data)


def _parsed(text: str) -> _Tags:
    tags = _Tags()
    tags.feed(text)
    assert not tags.wrong and not tags.open
    return tags


def test_page_is_well_formed_and_needs_nothing_else(cart):
    text = page(gathered(cart))
    tags = _parsed(text)
    assert not [t for t, a in tags.seen if t in ("link", "img", "iframe") or "src" in a]
    policy = next(a["content"] for t, a in tags.seen if "http-equiv" in a)
    assert policy.startswith("default-src 'none'") and "unsafe-eval" not in policy
    assert policy.count("'sha256-") == 2 and "http" not in policy
    ids = [a["id"] for _, a in tags.seen if "id" in a]
    assert len(ids) == len(set(ids))


def unwrapped(text: str) -> str:
    """Return a page whose commands are not divided into words that are not broken."""
    return text.replace("<span>", "").replace("</span>", "")


def _panels(text: str) -> list[dict[str, Any]]:
    data = text.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    return list(json.loads(data)["panels"])


def test_the_page_shows_what_was_found(cart):
    html = page(gathered(cart))
    text = "".join(_parsed(html).text).replace("\xa0", " ").replace("\u2060", "")
    for fact in (
        "viscous_friction:v",
        "0.300 ± 0.010",
        " adopt viscous_friction:v",
        "N s/m",
        "1.400 ± 0.020",
    ):
        assert fact in text, fact


def test_the_panels_hold_the_numbers(cart):
    findings = gathered(cart)
    best = findings.best
    assert best is not None
    panels = _panels(page(findings))
    traces = [t for p in panels if p["kind"] == "time" for t in p["data"]]
    x = next(t["y"] for t in traces if t["name"].startswith("best so far"))
    np.testing.assert_allclose(unpacked(x), best.trial.states[:, 0], atol=1e-5)
    kinds = [p["kind"] for p in panels]
    assert {"path", "time", "forecast"} <= set(kinds)
    ghosts = [t for p in panels for t in p["data"] if t["meta"]["style"] == "ghost"]
    assert {t["meta"]["trial"] for t in ghosts} == {run.trial.id for run in findings.runs}


def test_commands_name_the_workspace_as_it_was_named(car):
    findings = replace(gathered(car), folder="my robot")
    text = unwrapped(page(findings))
    assert "<code>grounded diagnose" not in text
    assert text.count("grounded -C &#39;my robot&#39; diagnose") >= 2
    assert f"grounded -C &#39;my robot&#39; {findings.then.verb}" in text


def test_page_of_many_long_trials_is_small_and_quick():
    findings = many_flights()
    start = time.process_time()
    text = page(findings)
    assert len(text.encode()) < 8e6
    assert time.process_time() - start < 10.0 * slowness()
    _parsed(text)


def hostile(folder):
    """Findings with hostile text wherever a stranger could put it."""
    findings = gather(Folder(folder))
    document = json.loads(json.dumps(DIAGNOSIS).replace("viscous_friction:v", "EVIL"))
    document = json.loads(json.dumps(document).replace('"EVIL"', json.dumps(EVIL)))
    document["verdict"]["sentence"] = document["next_trial"] = document["gap"]["unit"] = EVIL
    document["where"]["channels"][0] |= {"name": EVIL, "unit": EVIL}
    document["where"]["regions"][0]["when"] = EVIL
    document["where"]["whiteness"][EVIL] = 0.0
    standing = replace(findings.standing, findings=(found("search.first", crashed=EVIL),))
    model = replace(
        findings.task.model,
        name=EVIL,
        states=dict.fromkeys(findings.task.model.states, EVIL),
        inputs=dict.fromkeys(findings.task.model.inputs, EVIL),
    )
    return replace(
        findings,
        name=EVIL,
        task=findings.task.with_model(model),
        effects=(EVIL,),
        method=EVIL,
        standing=standing,
        lost=(Lost(EVIL, EVIL),),
        diagnosis=Diagnosis.from_json(document),
        then=NextCommand(EVIL),
    )


def test_names_are_text_never_markup(cart):
    text = page(hostile(cart))
    tags = _parsed(text)
    assert not [a for t, a in tags.seen if t == "img" or "onerror" in a]
    assert [t for t, _ in tags.seen].count("script") == 3  # the data, Plotly, our own
    assert "".join(tags.text).count("window.hacked=2") > 10


def weighed(findings, **weights):
    """The findings with other weights on the states along the way, none at the end."""
    names = findings.task.model.state_names
    state = np.array([weights.get(name, 0.0) for name in names])
    reward = replace(findings.task.reward, state=state, terminal=0 * state)
    target = np.nan_to_num(findings.task.target)
    return replace(findings, task=replace(findings.task, reward=reward, target=target))


def test_no_path_is_desired_of_a_state_without_a_weight(car):
    findings = weighed(gathered(car), x=10.0, y=10.0)
    states, errors = state_figure(findings), error_figure(findings)
    assert states is not None and errors is not None
    desired = {
        p.title for p in states.panels if any(c["meta"]["role"] == "desired" for c in p.curves)
    }
    assert desired == {"x [m]", "y [m]"} and "v [m/s]" in {p.title for p in states.panels}
    assert not any(p.title.startswith(("v ", "psi ")) for p in errors.panels)
    assert not any("desired at" in str(t.get("text")) for p in states.panels for t in p.data)


def test_states_that_no_sensor_gives_are_said_to_be_estimates(cart):
    findings = gathered(cart)
    assert findings.estimated == () and ESTIMATED not in page(findings)
    findings = replace(findings, estimated=("v",))
    states = state_figure(findings)
    assert states is not None
    for figure in (states, forecast_figures(findings)[0]):
        notes = {p.title: p.note for p in figure.panels}
        assert ESTIMATED in notes["v [m/s]"] and ESTIMATED not in notes["x [m]"]


def _jump(states):
    states[15:], states[16::2] = 1e300, -1e300


CASES = {
    "huge": lambda s: s.fill(1e200),
    "jumps": _jump,
    "zero": lambda s: s.fill(0.0),
    "infinite": lambda s: s[10:].fill(np.inf),
    "unknown": lambda s: s.fill(np.nan),
    "tiny": lambda s: s.fill(1e-300),
    "constant": lambda s: s.fill(1e12),
    "offset": lambda s: np.copyto(s, 1e9 + 1e-3 * np.random.default_rng(0).random(s.shape)),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
@pytest.mark.extra("view", "png")
def test_a_report_is_made_of_any_numbers(car, tmp_path, case):
    from grounded_trials.report.recording import write_recording

    findings, runs = gathered(car), []
    for run in findings.runs:
        states = np.array(run.trial.states)
        CASES[case](states)
        states[np.abs(states) > RUNAWAY] = np.nan  # as they are gathered
        runs.append(replace(run, trial=replace(run.trial, states=states)))
    findings = replace(findings, runs=tuple(runs))
    head, data = page(findings).split('id="data">')
    assert "nan" not in head.split("<style>")[0].lower() + head.split("</style>")[1].lower()
    assert json.loads(data.split("</script>")[0])["panels"]
    figure = all_figures(findings)[1 + list(CASES).index(case) % 2]  # the paths, the states
    assert len(png(figure)) > 1000
    write_recording(findings, tmp_path / "r.rrd")
    assert "next: grounded" in report_text(findings)
