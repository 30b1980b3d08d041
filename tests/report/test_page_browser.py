"""The page in a real browser: drawn, zoomed, switched, moved, dark, narrow, printed, reloaded."""

from __future__ import annotations

import base64
import re
import time

import numpy as np
import pytest
from test_page import hostile

from grounded_trials.report.page import page
from page_browser import browser, missing
from reported import gathered

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
