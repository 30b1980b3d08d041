"""The page: complete, alone, safe from names, and seen in a real browser at two widths."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from grounded.diagnosis.report import Diagnosis
from grounded.errors import NextCommand
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.page import page
from grounded_trials.workspace.folder import Folder, Lost
from page_browser import browser, missing
from reported import DIAGNOSIS, car, cart, many_flights

__all__ = ["car", "cart"]
needs_browser = pytest.mark.skipif(bool(missing()), reason=missing() or "-")
EVIL = '<img src=x onerror="window.hacked=1"></script><script>window.hacked=2</script>\'&'


@pytest.fixture(scope="module")
def window():
    with browser() as opened:
        yield opened


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
    text = page(gather(Folder(cart)))
    tags = _parsed(text)
    assert not [t for t, a in tags.seen if t in ("link", "img", "iframe") or "src" in a]
    assert set(re.findall(r"https?://[^\s\"']+", text)) <= {"http://www.w3.org/2000/svg"}
    ids = [a["id"] for _, a in tags.seen if "id" in a]
    assert len(ids) == len(set(ids))


def test_page_shows_what_the_issue_lists(cart):
    text = "".join(_parsed(page(gather(Folder(cart)))).text)
    for words in (
        "Utility of each candidate",
        "Step size",
        "desired",
        "model’s policy",
        "best so far",
        "Tracking error",
        "limit",
        "Bias",
        "Share of the gap by channel",
        "Share of the gap by time",
        "Share of the gap by region",
        "viscous_friction:v",
        "0.290 to 0.330",  # the 95 % interval, which is not symmetric
        "Prediction error 1 s ahead",
        "noise alone",
        "explains 90 %",
        "a fast run and a slow one",
        "grounded adopt viscous_friction:v",
        "N s/m",
        "1.400 (1.36 to 1.44)",
        "x > 0.2",
        "model as diagnosed",
        "90.5 % of the squared error is explained",
        "whole run (2 s)",
        "By state, 1 s ahead",
        "What is left of v is no white noise",
        "by 3.21, the diagnosed one by 0.0456",
        "coulomb_friction:v",
        "96.0 %",
        "first or better",
        "no better",
    ):
        assert words in text, words


def test_page_of_an_older_diagnosis_leaves_out_what_it_lacks(cart):
    findings = gather(Folder(cart))
    new = ("split", "whiteness")
    where = {key: value for key, value in DIAGNOSIS["where"].items() if key not in new}
    old = {k: v for k, v in DIAGNOSIS.items() if k not in ("utility_prediction", "lookalikes")}
    text = page(replace(findings, diagnosis=Diagnosis.from_json(old | {"where": where})))
    for words in ("What the error is made of", "Is the rest noise", "Look-alikes", "predicted<"):
        assert words not in text


def test_page_without_a_diagnosis_names_the_command(car):
    assert "grounded diagnose" in page(gather(Folder(car)))


def test_page_is_the_same_every_time(cart):
    assert page(gather(Folder(cart))) == page(gather(Folder(cart)))


def test_page_of_many_long_trials_is_small_and_quick():
    findings = many_flights()
    start = time.process_time()
    text = page(findings)
    assert len(text.encode()) < 2e6
    assert time.process_time() - start < 10.0
    _parsed(text)


def hostile(folder):
    """Findings with hostile text wherever a stranger could put it."""
    findings = gather(Folder(folder))
    document = json.loads(json.dumps(DIAGNOSIS).replace("viscous_friction:v", "EVIL"))
    document = json.loads(json.dumps(document).replace('"EVIL"', json.dumps(EVIL)))
    document["verdict"]["sentence"] = document["next_trial"] = document["gap"]["unit"] = EVIL
    document["where"]["channels"][0] |= {"name": EVIL, "unit": EVIL}
    document["where"]["regions"][0]["when"] = EVIL
    document["where"]["split"]["horizon"]["channels"][0]["name"] = EVIL
    document["where"]["whiteness"][EVIL] = 0.0
    document["lookalikes"][0]["like"] = EVIL
    standing = replace(findings.standing, sentence=EVIL)
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
    assert [t for t, _ in tags.seen].count("script") == 1
    assert "".join(tags.text).count("window.hacked=2") > 10


@needs_browser
def test_hostile_names_run_nothing_in_a_browser(cart, tmp_path, window):
    path = tmp_path / "page.html"
    path.write_text(page(hostile(cart)))
    window.open(path)
    assert window.run("return document.documentElement.dataset.ready") == "yes"
    window.point("svg.plot", 0.5, 0.5)
    window.run("document.querySelectorAll('[data-note]').forEach(e => e.focus())")
    assert window.run("return window.hacked") is None
    assert window.errors() == []


@needs_browser
@pytest.mark.parametrize("width", [1400, 390])
@pytest.mark.parametrize("dark", [False, True])
def test_page_in_a_browser(cart, tmp_path, window, width, dark):
    path = tmp_path / "page.html"
    path.write_text(page(gather(Folder(cart))))
    window.resize(width, 900)
    window.dark(dark)
    window.open(path)
    assert window.run("return document.documentElement.dataset.ready") == "yes"
    assert window.errors() == []
    assert window.run("return document.documentElement.scrollWidth") <= width
    for heading in ("Utility", "Paths", "States", "Inputs", "Bias", "Gap", "What to run next"):
        found = window.run(
            "return [...document.querySelectorAll('h2')].filter(h => h.textContent === arguments[0]"
            " && h.getBoundingClientRect().height > 10).length",
            heading,
        )
        assert found == 1, heading
    drawn = window.run(
        "return [...document.querySelectorAll('.panels svg')].map(s => {"
        " const b = s.getBoundingClientRect(); return [b.width, b.height, b.right]; })"
    )
    assert len(drawn) >= 10
    assert all(w > 300 and h > 40 and right <= width for w, h, right in drawn)
    back = window.run("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", back)[:3])) < 200) == dark
    assert len(window.picture()) > 20_000


@needs_browser
def test_hovering_shows_the_values(cart, tmp_path, window):
    findings = gather(Folder(cart))
    path = tmp_path / "page.html"
    path.write_text(page(findings))
    window.resize(1400, 900)
    window.open(path)
    number = window.run(
        "const all = [...document.querySelectorAll('svg.plot')];"
        "const k = all.findIndex(s => s.getAttribute('aria-label') === 'x [m]');"
        "all[k].id = 'probe'; return k;"
    )
    assert number >= 0
    window.point("#probe", 0.5, 0.4)
    tip = window.run("return document.getElementById('tip').innerText")
    found = re.search(r"time \[s\]: ([\d.]+)", tip)
    assert found, tip
    t = float(found[1])
    best = findings.best
    assert best is not None
    real = np.interp(t, np.arange(best.trial.steps + 1) * findings.task.dt, best.trial.states[:, 0])
    shown = re.search(r"(-?[\d.]+)\s+best so far", tip)
    assert shown and float(shown[1]) == pytest.approx(real, abs=0.02)
    assert window.errors() == []


@needs_browser
def test_marks_say_what_they_are_and_tables_can_be_copied(cart, tmp_path, window):
    path = tmp_path / "page.html"
    path.write_text(page(gather(Folder(cart))))
    window.open(path)
    window.run("document.querySelector('circle[data-note]').focus()")
    tip = window.run("return document.getElementById('tip').innerText")
    assert "c0001, iteration 0" in tip and "utility" in tip
    copied = window.run(
        "let text = ''; const area = () => document.querySelector('textarea').value;"
        "document.execCommand = () => { text = area(); };"
        "navigator.clipboard.writeText = () => Promise.reject();"
        "document.querySelector('button[data-copy=errors]').click();"
        "return new Promise(done => setTimeout(() => done(text), 100));"
    )
    rows = [line.split("\t") for line in copied.split("\n")]
    assert rows[0][:2] == ["state", "unit"] and rows[1][:2] == ["x", "m"]
    assert len({len(row) for row in rows}) == 1
    assert window.errors() == []


@needs_browser
def test_page_of_many_trials_in_a_browser(tmp_path, window):
    path = tmp_path / "page.html"
    path.write_text(page(many_flights(12)))
    window.resize(390, 900)
    window.open(path)
    assert window.errors() == []
    assert window.run("return document.documentElement.scrollWidth") <= 390


@pytest.mark.parametrize("interval", [None, [None, None], [-3e9, 3e9], [0.4, 0.5]])
def test_a_value_without_an_interval_is_said_to_be_undetermined(cart, interval):
    value = {"value": 0.3, "std": 0.01, "unit": "1/s", "interval": interval}
    entry = DIAGNOSIS["ranking"][0] | {"params": {"k": value}}
    findings = gather(Folder(cart))
    text = page(replace(findings, diagnosis=Diagnosis.from_json(DIAGNOSIS | {"ranking": [entry]})))
    assert "k = –, not determined by these trials<" in text
    assert "0.280 to 0.320" not in text
