"""Pages in a browser: nothing cut, too pale or fetched; values under the pointer are those drawn.

Kinds of pages that take long to compute are looked at where other tests compute them (`faults_seen`).
"""

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from plant import paper_link
from tests.browser import AXE, PROGRAM, Browser, barriers
from tests.workflow import report_examples as example
from tests.workflow.page_shape import shape_faults
from workflow.excite.experiment import ExperimentLimits, plan_experiment
from workflow.excite.page import experiment_page
from workflow.figures.bode import draw_bode
from workflow.figures.poles import draw_poles
from workflow.report import rendering
from workflow.report.pages import write_report
from workflow.report.rendering import render_described, render_page
from workflow.tasks.results import RunResults
from workflow.text.templates import environment

pytestmark = pytest.mark.skipif(PROGRAM is None, reason="chromium is not installed")

OMEGA = np.geomspace(0.3, 300, 200)
PAGE = """
{% extends "base.html.j2" %}
{% from "macros.html.j2" import section, figure with context %}
{% block body %}
{% call section("shown", "Shown", "Shown", open=true) %}
{% call figure("bode") %}A response.{% endcall %}
{% call figure("poles") %}Its poles.{% endcall %}
{% endcall %}
{% call section("folded", "Folded", "Folded", open=false) %}<p id="inside">Words.</p>{% endcall %}
{% endblock %}
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    """A page of two pictures."""
    drawn = {
        "bode": lambda: draw_bode(example.posterior(example.model()).at(OMEGA), "hub", "rad / V"),
        "poles": lambda: draw_poles(example.model(), "hub"),
    }
    path = tmp_path_factory.mktemp("page") / "page.html"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendering, "drawings", lambda: drawn)
        made = environment().from_string(PAGE)
        patch.setattr(rendering, "environment", lambda *_: SimpleNamespace(get_template=lambda _: made))
        path.write_text(render_page("", title="A page").html)
    return path


@pytest.fixture
def opened(browser: Browser, page: Path) -> Browser:
    browser.open(page)
    return browser


def place(browser: Browser, x: float, y: float) -> tuple[float, float]:
    """Where a point of the first picture [its units] lies in the window [px]."""
    matrix = "(m => [m.a, m.d, m.e, m.f])(document.querySelector('.plot > svg').getScreenCTM())"
    a, d, e, f = browser.ask(matrix)
    return a * x + e, d * y + f


def tip(browser: Browser) -> dict[str, str]:
    rows = "[...document.querySelectorAll('.tip:not([hidden]) div')]"
    return dict(browser.ask(f"{rows}.map(row => [...row.children].map(cell => cell.textContent))"))


def value(words: str) -> float:
    found = re.match(r"−?[\d.e]+(?:−\d+)?", words)
    assert found
    return float(found[0].replace("−", "-"))


def axes(browser: Browser, number: int) -> dict:
    return browser.ask(f"JSON.parse(document.querySelector('.plot').dataset.plot).axes[{number}]")


def test_values_under_the_pointer_are_those_drawn(opened):
    """The gain of the identified response, at places all over its panel, zoomed and not."""
    response = example.posterior(example.model()).at(OMEGA).centre
    logs = np.log(OMEGA), np.log(np.abs(response))
    left, top, right, bottom = axes(opened, 0)["box"]
    for zoomed in (False, True):
        for share in (0.2, 0.47, 0.8):
            opened.mouse("mouseMoved", *place(opened, left + share * (right - left), (top + bottom) / 2))
            shown = tip(opened)
            # Between the frequencies of the picture it is drawn straight, on logarithmic axes; a hundredth of
            # a unit of the picture is worth 0.1 % here.
            wanted = np.exp(np.interp(np.log(value(shown["frequency"])), *logs))
            assert value(shown["identified response (centre)"]) == pytest.approx(wanted, rel=0.004)
        if not zoomed:
            drag(opened, (left + 0.1 * (right - left), top + 2), (left + 0.9 * (right - left), bottom - 2))
            assert opened.ask("document.querySelectorAll('[data-added]').length") > 4


def drag(browser: Browser, start: tuple[float, float], end: tuple[float, float]) -> None:
    browser.mouse("mousePressed", *place(browser, *start), down=True)
    browser.mouse("mouseMoved", *place(browser, *end), down=True)
    browser.mouse("mouseReleased", *place(browser, *end), down=True)


def test_a_zoom_shows_its_part_and_goes_back(opened):
    left, top, right, bottom = axes(opened, 0)["box"]
    low, high, _ = axes(opened, 0)["x"]
    drag(opened, (left + 0.5 * (right - left), top + 5), (left + 0.6 * (right - left), bottom - 5))
    # The left edge of the panel is now the middle of the whole, on a logarithmic axis.
    opened.mouse("mouseMoved", *place(opened, left + 1, (top + bottom) / 2))
    assert value(tip(opened)["frequency"]) == pytest.approx(np.sqrt(low * high), rel=0.02)
    labels = "[...document.querySelectorAll('.plot')][0].querySelectorAll('.x[data-added] text').length"
    assert opened.ask(labels) >= 3
    opened.press("Escape")
    assert opened.ask("document.querySelectorAll('[data-added]').length") == 0
    opened.mouse("mouseMoved", *place(opened, left + 1, (top + bottom) / 2))
    assert value(tip(opened)["frequency"]) == pytest.approx(low, rel=0.02)


def test_an_entry_of_the_legend_hides_what_it_names_by_mouse_and_keys(opened):
    hidden = "[...document.querySelectorAll('.plot')[0].querySelectorAll('.k1')].map(g => g.style.display)"
    assert set(opened.ask(hidden)) == {""}
    assert len(opened.ask(hidden)) == 2  # in the panels of gain and phase
    opened.ask("document.querySelectorAll('[data-entry]')[1].focus()")
    opened.press("Enter")
    assert set(opened.ask(hidden)) == {"none"}
    left, top, right, bottom = axes(opened, 0)["box"]
    opened.mouse("mouseMoved", *place(opened, (left + right) / 2, (top + bottom) / 2))
    assert "identified response (centre)" not in tip(opened)
    opened.ask("document.querySelectorAll('[data-entry]')[1].click()")
    assert set(opened.ask(hidden)) == {""}


def test_keys_read_values_and_open_what_a_link_leads_to(opened):
    opened.ask("document.querySelector('.plot').focus()")
    opened.press("ArrowRight")
    first = value(tip(opened)["frequency"])
    opened.press("ArrowRight")
    assert value(tip(opened)["frequency"]) > first
    assert opened.ask("document.querySelector('#folded details').open") is False
    opened.ask("location.hash = 'inside'")
    opened.ask("new Promise(done => setTimeout(done, 50))")
    assert opened.ask("document.querySelector('#folded details').open") is True


def test_a_picture_saved_from_the_page_looks_like_itself(opened):
    """The link's target is caught: an SVG with the styles it needs, and a PNG."""
    catch = "function () { saved.push([this.download, this.href]); }"
    opened.ask(f"window.saved = []; HTMLAnchorElement.prototype.click = {catch}")
    opened.ask("document.querySelectorAll('figure > .tools button')[1].click()")
    opened.ask("document.querySelectorAll('figure > .tools button')[2].click()")
    opened.ask("new Promise(done => setTimeout(done, 700))")
    (svg, content), (png, image) = opened.ask("saved")
    assert (svg, png) == ("bode.svg", "bode.png")
    assert content.startswith("data:image/svg+xml")
    assert "stroke" in content
    assert image.startswith("data:image/png;base64,")
    assert len(image) > 20_000  # an empty canvas of this size has less


def test_a_narrow_screen_gets_panels_below_each_other(browser, faults_seen, page):
    assert faults_seen(page) == []
    browser.open(page, 400)
    widths = (
        "[...document.querySelectorAll('.parted > svg.part')].map(svg => svg.getBoundingClientRect().width)"
    )
    assert len(browser.ask(widths)) == 2  # the two panels of the poles
    assert min(browser.ask(widths)) > 350


def test_one_wide_panel_is_laid_out_anew_on_a_narrow_screen(opened):
    """Gain over phase: as wide as the screen with letters to read; hidden entries, values and the title with
    them."""
    seen = "[...document.querySelectorAll('figure')][0].querySelectorAll('.plot')"
    shown = f"[...{seen}].filter(plot => plot.checkVisibility()).map(plot => plot.className)"
    assert opened.ask(shown) == ["plot wide"]
    gain = "identified response (centre)"
    left, top, right, bottom = axes(opened, 0)["box"]
    opened.mouse("mouseMoved", *place(opened, (left + right) / 2, (top + bottom) / 2))
    on_a_wide_screen = tip(opened)

    opened.resize(400)
    assert opened.ask(shown) == ["plot narrow"]
    part = "document.querySelector('.plot.narrow')"
    letters = f"{part}.querySelector('svg').getScreenCTM().a * 9"
    assert opened.ask(letters) > 10
    inside = (
        f"(frame => [...{part}.querySelectorAll('text')].every(text => (box => box.left >= frame.left - 1"
        f" && box.right <= frame.right + 1)(text.getBoundingClientRect())))({part}.getBoundingClientRect())"
    )
    assert opened.ask(inside)
    # The middle of the panel is the same frequency and the same gain.
    left, top, right, bottom = opened.ask(f"JSON.parse({part}.dataset.plot).axes[0].box")
    matrix = f"(m => [m.a, m.d, m.e, m.f])({part}.querySelector('svg').getScreenCTM())"
    a, d, e, f = opened.ask(matrix)
    opened.mouse("mouseMoved", a * (left + right) / 2 + e, d * (top + bottom) / 2 + f)
    on_a_narrow_screen = tip(opened)
    for name in ("frequency", gain):
        assert value(on_a_narrow_screen[name]) == pytest.approx(value(on_a_wide_screen[name]), rel=0.02)
    opened.ask("document.querySelectorAll('[data-entry]')[1].click()")
    hidden = f"[...{part}.querySelectorAll('.k1')].map(group => group.style.display)"
    assert set(opened.ask(hidden)) == {"none"}


@pytest.mark.parametrize(
    "channels", [pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.long)]
)
def test_report_of_a_run(browser, faults_seen, tmp_path, channels):
    settings = example.config(channels=channels)
    path = write_report(RunResults(example.build_run(tmp_path / "run", settings)), settings)
    assert faults_seen(path) == []
    assert path.stat().st_size < 500_000
    if channels == 1:  # two channels of one made-up model say the same of themselves
        assert shape_faults(browser, path, screens=2.5, words=450) == []


@pytest.mark.parametrize("width", [pytest.param(1280, marks=pytest.mark.slow), 400])
def test_a_page_without_its_script_shows_numbers_tables_and_the_first_picture(browser, tmp_path, width):
    """Where a browser runs no script: on the first screen at once, in folded parts once they are opened."""
    settings = example.config(channels=1)
    path = write_report(RunResults(example.build_run(tmp_path / "run", settings)), settings)
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(path, width)
        assert browser.ask("document.querySelectorAll('.tools').length") == 0  # the script has not run
        seen = "[...document.querySelectorAll('{}')].filter(item => item.checkVisibility()).length"
        assert browser.ask(seen.format(".numbers dd")) > 2
        drawn = (
            "[...document.querySelectorAll('.plot > svg')].filter(item => item.checkVisibility())[0]"
            ".querySelectorAll('.m path, .m use').length"
        )
        assert browser.ask(drawn) > 2
        for summary in range(browser.ask("document.querySelectorAll('summary').length")):
            browser.ask(f"document.querySelectorAll('summary')[{summary}].parentElement.open = true")
        assert browser.ask(seen.format("td")) > 20
        empty = (
            "[...document.querySelectorAll('figure')].filter(figure => ![...figure.querySelectorAll('svg')]"
            ".some(image => image.checkVisibility() && image.getBoundingClientRect().height > 50)).length"
        )
        assert browser.ask(empty) == 0
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)


def test_the_shape_of_a_page_is_measured(browser, tmp_path):
    """Every fault is found on a page that has them all."""
    path = tmp_path / "long.html"
    words = "The same six words are here. " * 160
    tall = '<div class="plot"><svg style="display:block;height:5000px"></svg></div>'
    bullets = f"<ul class='bullets'>{'<li>x</li>' * 6}</ul>"
    headline = f"<p class='headline' style='line-height:20px'>{'verdict ' * 90}</p>"
    path.write_text(f"<!DOCTYPE html><body><h1>x</h1>{headline}{tall}<p>{words}</p>{bullets}")
    faults = "; ".join(shape_faults(browser, path, screens=5))
    for fault in ("screens", "words, at most", "more than 1 line", "picture ends", "0 numbers", "6 bullets"):
        assert fault in faults
    assert "said twice: the same six words are here" in faults
    assert "html-has-lang" in str(barriers(browser)) or AXE is None


@pytest.mark.slow
def test_page_of_a_planned_experiment(faults_seen, tmp_path):
    limits = ExperimentLimits(
        band_Hz=(0.5, 90.0), dt_s=0.005, duration_s=40.0, peak_V=24.0, rig=paper_link(), noise_std_rad=1e-3
    )
    plan = plan_experiment(limits, seed=1, realisations=2)
    path = tmp_path / "plan.html"
    path.write_text(render_described(experiment_page(plan)).html)
    assert faults_seen(path) == []
