"""The page: complete, alone, small, safe from names."""

from __future__ import annotations

import json
import re
import time
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from facts import holds
from grounded.diagnosis.error_report import Split
from grounded.diagnosis.report import Diagnosis, Made
from grounded.errors import NextCommand
from grounded.model import Param
from grounded_trials.report.findings import Improved, improvements_in, utility_terms
from grounded_trials.report.gathering import gather
from grounded_trials.report.page.diagnosed import _made_of, _rest
from grounded_trials.report.page.page import page
from grounded_trials.report.page.tables import UNKNOWN, parameter_table
from grounded_trials.report.report_text import report_text
from grounded_trials.workspace.folder import Folder, Lost
from grounded_trials.workspace.last_diagnosis import Since
from grounded_trials.workspace.off_target import tracking_error
from pace import slowness
from page_browser import unpacked
from reported import DIAGNOSIS, car, cart, many_flights

__all__ = ["car", "cart"]
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
    text = page(gather(Folder(cart)))
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


def test_page_shows_what_the_issue_lists(cart):
    html = page(gather(Folder(cart)))
    text = "".join(_parsed(html).text)
    for words in (
        "What the runs changed",  # at the end the distance is worse
        "Why the model was wrong",
        "What to run next",
        "Utility of each candidate",
        "Step size",
        "desired",
        "model’s policy",
        "best so far",
        "Tracking error",
        "Bias",
        "Predictions before and after",
        "Share of the gap by channel",
        "Share of the gap by time",
        "Share of the gap by region",
        "viscous_friction:v",
        "0.290 to 0.330",  # the 95 % interval, which is not symmetric
        "explains 90\xa0%",
        "a fast run and a slow one",
        " adopt viscous_friction:v",
        "N s/m",
        "1.400 (1.36 to 1.44)",
        "x\xa0>\xa00.2",
        "90.5 %",  # of the squared error is explained
        "whole run (2 s)",
        "By state, 1 s ahead",
        "Is there a pattern in the rest?",
        "3.21 by the model, 0.0456 by the diagnosed one",
        "coulomb_friction:v",
        "96.0 %",
        "maybe better or better",
        "no better",
        "What the model lacks",
    ):
        assert words in text, words


def test_the_panels_hold_the_numbers(cart):
    findings = gather(Folder(cart))
    best = findings.best
    assert best is not None
    panels = _panels(page(findings))
    traces = [t for p in panels if p["kind"] == "time" for t in p["data"]]
    x = next(t["y"] for t in traces if t["name"].startswith("best so far"))
    np.testing.assert_allclose(unpacked(x), best.trial.states[:, 0], atol=1e-5)
    kinds = [p["kind"] for p in panels]
    assert {"path", "time", "forecast", "bars"} <= set(kinds)
    ghosts = [t for p in panels for t in p["data"] if t["meta"]["style"] == "ghost"]
    assert {t["meta"]["trial"] for t in ghosts} == {run.trial.id for run in findings.runs}


def test_what_improved_is_said_in_the_units_of_the_states(car):
    found = improvements_in(gather(Folder(car)))
    assert found[0].what == "distance from the desired position, rms" and found[0].unit == "m"
    assert re.fullmatch(r"[\d.]+ (m|cm|mm) → [\d.]+ (cm|mm)", found[0].text)
    assert found[0].after < found[0].before
    assert {"rad", "m/s"} <= {one.unit for one in found}


def test_nothing_is_said_to_improve_that_did_not(car):
    """A car's page said "What improved" over "9 trials, 0 improvements"."""

    def heading(findings):
        found = re.search('id="improved"><h2>(.*?)</h2>', page(findings))
        assert found is not None
        return found[1]

    findings = gather(Folder(car))
    now, runs = findings.standing, findings.runs
    assert heading(findings) == "What improved"
    first = now.history[0]
    assert "still the best" in heading(replace(findings, standing=replace(now, incumbent=first)))
    none = replace(now, incumbent=first, history=(first,))
    assert heading(replace(findings, standing=none)) == "Results"
    best = findings.best
    assert best is not None
    states = best.trial.states.copy()
    states[:, findings.task.model.state_names.index("v")] += 2.0
    worse = [replace(r, trial=replace(r.trial, states=states)) for r in runs]
    runs = tuple(
        b if a.candidate is best.candidate else a for a, b in zip(runs, worse, strict=True)
    )
    assert heading(replace(findings, runs=runs)) == "What the runs changed"


def test_a_gain_that_scatter_may_explain_is_headed_perhaps(car):
    """An arm's page said "What improved" of 4 %, while its status said: perhaps."""
    findings = gather(Folder(car))
    now = findings.standing
    two = [now.history[0], next(t for t in now.history if t is now.incumbent)]

    def page_of(*pairs):
        unsure = tuple(
            replace(one, utilities=each, pieces=None, trials=one.trials * 2)
            for one, each in zip(two, pairs, strict=True)
        )
        return page(replace(findings, standing=replace(now, history=unsure, incumbent=unsure[1])))

    likelier_worse = page_of((-9.9, -10.7), (-10.0, -11.0))
    better = r"\(c\d{4} is better than c0001 with probability"
    told = rf"<h2>What the runs changed {better} 0\.[34]\d\)</h2>"
    assert re.search(told, likelier_worse)
    text = page_of((-10.0, -11.0), (-9.9, -10.7))
    assert re.search(rf"<h2>What perhaps improved {better} 0\.[67]\d\)</h2>", text)
    assert ": the scatter of repeats may explain the difference" in text
    assert "cost reduced" not in text and "cost raised" not in text
    assert "bias in 1 s, c0" in text and "bias per s" not in text  # its column is in rad, not rad/s


def test_a_diagnosis_that_is_not_the_last_word_says_no_next_trial(cart):
    """A car's page said "adopt them" nine runs after all of them had been adopted."""
    findings = gather(Folder(cart))
    assert "a fast run and a slow one" in page(findings)
    assert findings.diagnosis is not None
    made = Made(trials=("t0001",))
    findings = replace(findings, diagnosis=replace(findings.diagnosis, made=made))
    for since in (Since(newer=9), Since(changed=True), Since(adopted=("viscous_friction:v",))):
        assert "a fast run and a slow one" not in page(replace(findings, since=since))


def test_what_reads_the_same_before_and_after_is_not_told_first(car):
    """A quadrotor's page began with "0.11 m/s → 0.11 m/s"."""
    assert Improved("v", "m/s", 0.1101, 0.1099).is_same
    assert not Improved("v", "m/s", 0.1101, 0.1249).is_same
    assert not Improved("v", "m/s", float("nan"), 0.11).is_same
    findings = gather(Folder(car))
    first, best = findings.first, findings.best
    assert first is not None and best is not None
    v = findings.task.model.state_names.index("v")
    states = best.trial.states.copy()
    states[:, v] = first.trial.states[:, v] + 1e-6  # weighed so much that it is all that pays
    runs = tuple(
        replace(r, trial=replace(r.trial, states=states)) if r.candidate is best.candidate else r
        for r in findings.runs
    )
    reward = replace(
        findings.task.reward, state=np.where(np.arange(6) == v, 1e12, findings.task.reward.state)
    )
    found = improvements_in(
        replace(findings, task=replace(findings.task, reward=reward), runs=runs)
    )
    told_same = [one.is_same for one in found]
    assert not told_same[0] and any(told_same)


def test_the_position_is_told_even_if_it_did_not_improve(car):
    """A boat's page gave three speeds and angles, and not that it stayed 31 cm off its path."""
    findings = gather(Folder(car))
    first, best = findings.first, findings.best
    assert first is not None and best is not None
    names = findings.task.model.state_names
    x, y = names.index("x"), names.index("y")
    states = best.trial.states.copy()
    states[:, [x, y]] = first.trial.states[:, [x, y]]
    runs = tuple(
        replace(r, trial=replace(r.trial, states=states)) if r.candidate is best.candidate else r
        for r in findings.runs
    )
    found = improvements_in(replace(findings, runs=runs))
    (told,) = [one for one in found if one.what.startswith("distance from the desired position")]
    assert told.is_same and not found[0].is_same and len(found) <= 4


def test_a_calibrated_model_is_not_called_crude(car):
    findings = gather(Folder(car))
    assert findings.plain == "crude model" and not findings.effects
    name, value = next(iter(findings.nominal.items()))
    other = replace(findings, nominal={**findings.nominal, name: 2 * value + 1})
    assert other.plain == "model with its present parameters"
    both = replace(other, effects=("dead_zone:u",)).plain
    assert both == "model with its present parameters, without adopted effects"


def test_errors_at_the_end_are_told_with_their_noise(cart):
    """65 mm -> 87 mm stood in large type, two samples of a boat at 99 and 104 mm."""
    findings = gather(Folder(cart))
    reward = replace(findings.task.reward, terminal=np.array([1e4, 0.0]))
    rng, runs = np.random.default_rng(0), []
    for one in findings.runs:
        states = one.trial.states + rng.normal(0, 0.03, one.trial.states.shape)
        runs.append(replace(one, trial=replace(one.trial, states=states)))
    task = replace(findings.task, reward=reward)
    found = improvements_in(replace(findings, task=task, runs=tuple(runs)))
    (end,) = [one for one in found if one.what.startswith("at the end: x")]
    assert re.search(r"; \+- \d+ mm( and \d+ mm)? by noise alone, from one run", end.what) or (
        "within its noise" in end.what
    )


def test_a_gain_at_the_end_is_said_first_and_the_terms_add_up(cart):
    """A crane's utility went from -4.232 to -2.549 at the end alone: "6.9 cm -> 7.0 cm"."""
    findings = gather(Folder(cart))
    reward = replace(findings.task.reward, terminal=np.array([1e4, 0.0]))
    task = replace(findings.task, reward=reward)
    runs = tuple(replace(r, utility=task.utility(r.trial)) for r in findings.runs)
    findings = replace(findings, task=task, runs=runs)
    first, best = findings.first, findings.best
    assert first is not None and best is not None
    found = improvements_in(findings)[0]
    assert found.what.startswith("at the end: x")
    off = tracking_error(task, first.trial)[-1, 0], tracking_error(task, best.trial)[-1, 0]
    np.testing.assert_allclose((found.before, found.after), np.abs(off))
    for run in (first, best):
        assert sum(task.terms(run.trial).values()) == pytest.approx(run.utility)
    rows, header = utility_terms(findings)
    assert header[1:] == (first.candidate.id, best.candidate.id)
    assert [row[0] for row in rows][1] == "states, at the end" and rows[-1][0] == "utility"
    assert 'id="terms"' in page(findings)


def test_page_of_an_older_diagnosis_leaves_out_what_it_lacks(cart):
    findings = gather(Folder(cart))
    new = ("split", "whiteness")
    where = {key: value for key, value in DIAGNOSIS["where"].items() if key not in new}
    old = {k: v for k, v in DIAGNOSIS.items() if k not in ("utility_prediction", "lookalikes")}
    text = page(replace(findings, diagnosis=Diagnosis.from_json(old | {"where": where})))
    for words in (
        "What the error is made of",
        "a pattern in the rest",
        "Look-alikes",
        "predicted<",
    ):
        assert words not in text


def test_an_error_that_is_all_noise_is_told_in_a_sentence_and_one_of_no_known_part_not_at_all():
    def blocks(**parts):
        one = {"name": "x", "unit": "m", "rms": 0.1}
        split = {"horizon_s": 1.0, "all": parts, "channels": [one | parts]}
        known = Split.from_json(split | {"irreducible_from": "repeats"})
        return _made_of({"horizon": known})

    assert blocks(explained=0.0) == [] == blocks(explained=0.0, unexplained=0.0, irreducible=0.0)
    (_, noise) = blocks(explained=0.0, unexplained=0.0, irreducible=1.0)
    assert noise.kind == "text" and holds(noise.text, "within the noise", "scatter of repeated")
    unknown = blocks(explained=0.0, irreducible=1.0)  # what is left may be more than noise
    assert "table" in [block.kind for block in unknown]
    some = blocks(explained=0.2, unexplained=0.0, irreducible=0.8)
    assert "table" in [block.kind for block in some]


def test_a_state_left_out_of_the_diagnosis_has_no_row(cart):
    """`v: 0.0 %, 0.0 %, 0.0 %` and `p = 1, white noise` were told of a state that was not used."""
    shares = {"explained": 0.2, "unexplained": 0.0, "irreducible": 0.8}
    each = [
        {"name": "x", "unit": "m", "rms": 0.1} | shares,
        {"name": "v", "unit": "m/s", "rms": 0.0} | dict.fromkeys(shares, 0.0),
    ]
    unknown = {"horizon_s": 1.0, "all": {}, "channels": each, "irreducible_from": "repeats"}
    found = _made_of({"horizon": Split.from_json(unknown)})
    assert [block.kind for block in found] == ["heading", "text", "folded"]  # no row of "-"
    assert [row[0] for row in found[-1].blocks[0].rows] == ["x"]
    (one, *_) = DIAGNOSIS["where"]["channels"]
    channels = [one | {"name": "x", "rms": 0.1}, one | {"name": "v", "rms": None}]
    where = DIAGNOSIS["where"] | {"channels": channels, "whiteness": {"x": 0.4, "v": 1.0}}
    (_, _, rest) = _rest(Diagnosis.from_json(DIAGNOSIS | {"where": where}))
    assert [row[0] for row in rest.rows] == ["x"]


def test_a_leftover_of_which_no_rate_is_known_makes_no_table(cart):
    (known, *_), heading = DIAGNOSIS["leftover"], "What no known effect explains"
    bare = {k: v for k, v in known.items() if k not in ("size", "unit", "evidence", "region")}
    findings = gather(Folder(cart))
    texts = [
        page(replace(findings, diagnosis=Diagnosis.from_json(DIAGNOSIS | {"leftover": [one]})))
        for one in (known, bare | {"error": 0.2, "floor": 0.1, "horizon_s": 1.0})
    ]
    assert [heading in text for text in texts] == [True, False]


@pytest.mark.parametrize("whole", ["|motor| > 0.477", "1e-05 kg", "-4.2 -> -2.5"])
def test_a_browser_breaks_no_quantity(cart, whole):
    """A line ended behind "|motor|", another began with "> 0.477"."""
    findings = gather(Folder(cart))
    document = DIAGNOSIS | {"verdict": DIAGNOSIS["verdict"] | {"sentence": f"It is {whole}."}}
    text = "".join(_parsed(page(replace(findings, diagnosis=Diagnosis.from_json(document)))).text)
    kept = whole.replace("->", "→").replace(" ", "\xa0")
    assert re.sub(r"-(?=\d)|\|", "\\g<0>\u2060", kept) in text


def test_page_without_a_diagnosis_names_the_command(car):
    assert "grounded diagnose" in unwrapped(page(replace(gather(Folder(car)), folder=None)))


def test_commands_name_the_workspace_as_it_was_named(car):
    findings = replace(gather(Folder(car)), folder="my robot")
    text = unwrapped(page(findings))
    assert "<code>grounded diagnose" not in text
    assert text.count("grounded -C &#39;my robot&#39; diagnose") >= 2
    assert f"grounded -C &#39;my robot&#39; {findings.then.verb}" in text


def test_a_parameter_without_bounds_is_a_constant(cart):
    findings = gather(Folder(cart))
    model = findings.task.model
    name, other = list(model.params)[:2]
    params = {name: Param(1.0, "kg"), other: Param(1.0, "kg", std=0.1)}
    task = findings.task.with_model(replace(model, params=dict(model.params) | params))
    (block,) = parameter_table(replace(findings, task=task))
    bounds = {row[0]: row[-1] for row in block.rows}
    assert bounds[name] == "constant" and bounds[other] == "none"


def test_trials_of_another_task_are_told_beside_those_that_count(cart):
    findings = replace(gather(Folder(cart)), uncounted=("t0091", "t0092"))
    for text in (page(findings), report_text(findings, lambda rows, header: "", lambda v: "")):
        assert "t0091 and t0092 count only as data" in " ".join(text.split())


def test_the_noise_of_whole_runs_is_not_told_where_it_is_not_known(cart):
    split = DIAGNOSIS["where"]["split"]
    parts = {"explained": 0.0, "unexplained": 0.53, "irreducible": 0.47}
    horizon = split["horizon"] | {"all": parts, "irreducible_unsure": 0.41}
    unknown = split["whole_run"] | {"all": {"explained": 0.0}}
    where = {"split": {"horizon": horizon, "whole_run": unknown}}
    document = DIAGNOSIS | {"where": DIAGNOSIS["where"] | where}
    findings = replace(gather(Folder(cart)), diagnosis=Diagnosis.from_json(document))
    text = page(findings)
    body = re.search(r'<table id="split".*?</table>', text, re.DOTALL)[0]
    assert re.findall(r"<td>(.*?)</td>", body) == [
        *("1 s", "0.0 %", "≤ 53 %", "≥ 47 %"),
        *("whole run (2 s)", "0.0 %", "-", "-"),
    ]


def test_page_is_the_same_every_time(cart):
    assert page(gather(Folder(cart))) == page(gather(Folder(cart)))


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
    assert [t for t, _ in tags.seen].count("script") == 3  # the data, Plotly, our own
    assert "".join(tags.text).count("window.hacked=2") > 10


@pytest.mark.parametrize("interval", [None, [None, None], [-3e9, 3e9], [0.4, 0.5]])
def test_a_value_without_an_interval_is_said_to_be_undetermined(cart, interval):
    value = {"value": 0.3, "std": 0.01, "unit": "1/s", "interval": interval}
    entry = DIAGNOSIS["ranking"][0] | {"params": {"k": value}}
    findings = gather(Folder(cart))
    text = page(replace(findings, diagnosis=Diagnosis.from_json(DIAGNOSIS | {"ranking": [entry]})))
    assert f"k = {UNKNOWN}<" in text
    assert "0.280 to 0.320" not in text


def _split_rows(irreducible_from, unexplained, irreducible):
    parts = {"unexplained": unexplained, "irreducible": irreducible}
    parts["explained"] = 1 - unexplained - irreducible
    split = {"horizon_s": 1.0, "all": parts, "channels": [{"name": "x"} | parts]}
    split |= {"irreducible_from": irreducible_from, "irreducible_unsure": 1.0}
    _, text, all_states, _ = _made_of({"horizon": Split.from_json(split)})
    return text.text, all_states.rows[0][1:]


def test_the_parts_of_an_error_say_what_may_be_noise_without_two_signs_in_a_cell():
    """`≤ < 0.1 %`, and `≥ < 0.1 %` in a column of noise "at most", said nothing."""
    text, row = _split_rows("alike", 0.0003, 0.0002)
    assert row == ("> 99.9 %", "< 0.1 %", "< 0.1 %") and "≤" not in text
    text, row = _split_rows("alike", 0.06, 0.04)
    assert row == ("90 %", "≤ 6.0 %", "10 %") and "≤" in text and "≥" not in text
    text, row = _split_rows("repeats", 0.001, 0.0004)
    assert row == ("99.9 %", "≤ 0.1 %", "≥ 0.0 %") and "≤ and ≥" in text
    _, row = _split_rows("at most", 0.0003, 0.0002)  # unexplained, at least: < 0.1 %
    assert row == ("> 99.9 %", "0.0 %", "< 0.1 %")


def test_noise_that_is_zero_everywhere_breaks_no_page():
    """A diagnosis without a cause, of exact trials: the page died by the minimum of nothing."""
    text, row = _split_rows("repeats", 0.5, 0.0)
    assert row == ("50 %", "50 %", "0.0 %") and "≤" not in text
