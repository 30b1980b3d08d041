"""The page in a real browser: drawn, zoomed, switched, moved, dark, narrow, printed, reloaded."""

from __future__ import annotations

import base64
import re
import time

import numpy as np
import pytest
from test_page import hostile

from cli import grounded
from grounded_trials.report.bodies import body_in
from grounded_trials.report.gathering import gather
from grounded_trials.report.page import page
from grounded_trials.workspace.folder import Folder
from page_browser import browser, missing
from reported import car, cart, gathered
from workspaces import make

__all__ = ["car", "cart"]
pytestmark = [
    pytest.mark.skipif(bool(missing()), reason=missing() or "-"),
    pytest.mark.extra("report"),
    pytest.mark.slow,
]


@pytest.fixture(scope="module")
def window():
    with browser() as opened:
        yield opened


@pytest.fixture(scope="module")
def car_page(car, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page.html"
    path.write_text(page(gathered(car)))
    return path


@pytest.fixture
def opened(window, car_page):
    """The car's page at a desk's width, every panel drawn; left open for the next test."""
    if not window.run("return document.documentElement.dataset.opened"):
        window.dark(False)
        window.resize(1400, 900)
        window.open(car_page)
        window.draw_all()
        window.run("document.documentElement.dataset.opened = 'for tests'")
    yield window
    window.key("states-0", "0")  # not zoomed
    assert window.errors() == []


def _range(window, plot):
    return window.run(
        "return document.getElementById(arguments[0]).layout.xaxis.range.map(Number)", plot
    )


def test_every_panel_is_drawn_when_it_comes_into_view(window, car_page):
    window.resize(1400, 900)
    window.open(car_page)
    drawn = "return document.querySelectorAll('.plot .main-svg').length"
    time.sleep(0.3)
    first = window.run(drawn)
    window.draw_all()
    assert 0 < first < window.run(drawn)
    sizes = window.run(
        "return [...document.querySelectorAll('.plot')].map(p => {"
        " const b = p.querySelector('.main-svg').getBoundingClientRect();"
        " return [b.width, b.height, b.right]; })"
    )
    assert len(sizes) >= 15
    assert all(w > 300 and h > 40 and right <= 1400 for w, h, right in sizes)
    assert window.errors() == []


def test_time_panels_zoom_together(opened):
    home = _range(opened, "states-0")
    opened.drag("states-0", 0.3, 0.6)
    low, high = _range(opened, "states-0")
    assert home[0] < low < high < home[1]
    for other in ("states-3", "error-0", "inputs-1"):
        assert _range(opened, other) == pytest.approx([low, high])
    assert _range(opened, "paths-0")[0] < 0  # a path's axes are no time
    opened.key("bias-0", "0")  # whose time ends a step earlier
    assert _range(opened, "states-3") == pytest.approx(home)


def test_a_trial_is_switched_off_and_on(opened):
    visible = (
        "return document.getElementById('paths-0')._fullData.filter(t => t.visible === true)"
        ".map(t => t.name)"
    )
    names = opened.run(visible)
    other = "[data-figure=paths] .chip:not([data-trial=''])"
    chip = opened.run("return document.querySelector(arguments[0]).dataset.name", other)
    opened.click(other)
    assert chip in names and chip not in opened.run(visible)
    opened.click(other)
    assert opened.run(visible) == names


def test_the_slider_moves_the_run_along_its_path(opened, car):
    findings = gathered(car)
    best = findings.best
    assert best is not None
    opened.run("document.getElementById('paths-0').scrollIntoView({block: 'center'})")
    opened.drag("time", 0.02, 0.5)
    slid = float(opened.run("return document.getElementById('time').value"))
    assert 1.2 < slid < 1.8
    at = opened.run(
        "const p = document.getElementById('paths-0'), { xaxis, yaxis } = p._fullLayout;"
        "return Object.fromEntries([...p.querySelectorAll('.over')].map(m => [m.dataset.name,"
        " [xaxis.p2l(parseFloat(m.style.left) - xaxis._offset),"
        "  yaxis.p2l(parseFloat(m.style.top) - yaxis._offset)]]))"
    )
    k = round(slid / findings.task.dt)
    columns = [findings.task.model.state_names.index(name) for name in ("x", "y")]
    for name, states in (
        ("real", best.trial.states),
        ("predicted", best.candidate.predicted_states),
        ("desired", findings.task.target),
    ):
        np.testing.assert_allclose(at[name], states[k, columns], atol=0.01, err_msg=name)


@pytest.fixture(scope="module")
def swing(tmp_path_factory):
    """A pendulum after two trials, and its page."""
    folder = tmp_path_factory.mktemp("swing") / "swing"
    make(folder, "pendulum")
    assert grounded("-C", folder, "learn", "--trials", 2).code == 0
    findings = gather(Folder(folder))
    path = folder / "page.html"
    path.write_text(page(findings))
    return findings, path


LINKS = (
    "const p = document.getElementById('paths-0'), { xaxis, yaxis } = p._fullLayout;"
    "return Object.fromEntries([...p.querySelectorAll('svg.body g')].map(g => ["
    " g.getAttribute('class'), [...g.children].map(line => line.getAttribute('d').slice(1)"
    "  .split('L').map(at => at.split(' ').map(Number))"
    "  .map(([x, y]) => [xaxis.p2l(x), yaxis.p2l(y)]))]))"
)


def _links_are_where_the_states_say(window, findings, run):
    body, k = body_in(findings), window.run("return document.documentElement.dataset.time")
    k = float(k) / findings.task.dt
    drawn = window.run(LINKS)
    for name, states in (
        ("real", run.trial.states),
        ("predicted", run.candidate.predicted_states),
        ("desired", findings.task.target),
    ):
        path = body.path(states)[:, [0, 2]]
        tip = [np.interp(k, np.arange(len(path)), axis) for axis in path.T]
        (link,) = drawn[name]
        np.testing.assert_allclose(link, [[0.0, 0.0], tip], atol=2e-3, err_msg=name)


def test_a_pendulum_swings_as_its_states_say(window, swing):
    findings, path = swing
    best, (first, *_) = findings.best, findings.runs
    window.dark(False)
    window.resize(1400, 900)
    window.open(path)
    window.draw_all()
    assert best is not None and best.trial.id != first.trial.id
    for start, end in ((0.02, 0.3), (0.3, 0.45)):
        window.drag("time", start, end)
        _links_are_where_the_states_say(window, findings, best)
    before = window.run(LINKS)["real"]
    window.drag("paths-0", 0.3, 0.7)  # zoomed: the body goes with it
    assert _range(window, "paths-0")[1] < 0.6
    _links_are_where_the_states_say(window, findings, best)
    window.run(
        "const w = document.getElementById('which'); w.value = arguments[0];"
        "w.dispatchEvent(new Event('change'))",
        first.trial.id,
    )
    time.sleep(0.3)
    _links_are_where_the_states_say(window, findings, first)
    assert window.run(LINKS)["real"] != before
    window.click("#play")
    time.sleep(0.5)
    window.click("#play")
    _links_are_where_the_states_say(window, findings, first)
    media = [{"media": "print"}, {"media": ""}]
    shown = (
        "return ['svg.body', 'i.over'].map("
        "e => getComputedStyle(document.querySelector(e)).display)"
    )
    window.devtools("Emulation.setEmulatedMedia", media[0])
    assert window.run(shown) == ["block", "none"]
    window.devtools("Emulation.setEmulatedMedia", media[1])
    assert window.errors() == []


@pytest.mark.parametrize(("width", "dark"), [(1400, False), (390, True)])
def test_light_and_dark_wide_and_narrow(window, car_page, width, dark):
    window.resize(width, 900)
    window.dark(dark)
    window.open(car_page)
    window.draw_all()
    assert window.run("return document.documentElement.scrollWidth") <= width
    gap = "Gap: model against reality"
    for heading in ("Results", "Why the model was wrong", "What to run next", "Paths", gap):
        found = window.run(
            "return [...document.querySelectorAll('h2')].filter(h => h.textContent === arguments[0]"
            " && h.getBoundingClientRect().height > 10).length",
            heading,
        )
        assert found == 1, heading
    back = window.run("return getComputedStyle(document.body).backgroundColor")
    assert (sum(map(int, re.findall(r"\d+", back)[:3])) < 200) == dark
    text = window.run("return document.getElementById('states-0').layout.font.color")
    assert text == ("#e8e8e8" if dark else "#1a1a1a")
    window.dark(not dark)
    time.sleep(0.5)
    text = window.run("return document.getElementById('states-0').layout.font.color")
    assert text == ("#1a1a1a" if dark else "#e8e8e8")
    assert window.errors() == []


def test_print_shows_every_panel_in_light_colours(window, car_page):
    window.dark(True)
    window.resize(1400, 900)
    window.open(car_page)
    window.run(
        "addEventListener('beforeprint', () => setTimeout(() => {}, 0));"
        "addEventListener('afterprint', () => { document.documentElement.dataset.printed ="
        " [...document.querySelectorAll('.plot')].every(p => p.querySelector('.main-svg')); })"
    )
    folded = "return document.querySelectorAll('details:not([open])').length"
    before = window.run(folded)
    assert before > 0
    made = window.devtools("Page.printToPDF", {"paperWidth": 8.27, "paperHeight": 11.69})
    assert window.run(folded) == before  # they are printed open, and folded again
    assert base64.b64decode(made["data"]).count(b"/Type /Page\n") >= 3
    assert window.run("return document.documentElement.dataset.printed") == "true"
    assert window.run("return document.getElementById('states-0').layout.font.color") == "#e8e8e8"
    assert window.errors() == []


def test_hostile_names_run_nothing(cart, tmp_path, window):
    path = tmp_path / "page.html"
    path.write_text(page(hostile(cart)))
    window.open(path)
    window.draw_all()
    window.point("#states-0", 0.5, 0.5)
    window.run("document.querySelectorAll('.plot').forEach(e => e.focus())")
    assert window.run("return window.hacked") is None
    assert window.errors() == []
