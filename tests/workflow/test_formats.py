"""Formats: every filter on its limiting cases. Templates: escaping, pictures, compiled ones kept."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest
from jinja2 import ChoiceLoader, DictLoader, Environment
from markupsafe import Markup

import workflow
from workflow.figures.description import Picture, new_picture
from workflow.figures.style import drawings
from workflow.report import rendering
from workflow.text import formats
from workflow.text.templates import CompiledTemplates, environment as shared, render_text

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (float("nan"), "not known"),
        (float("inf"), "unlimited"),
        (0.0, "0"),
        (1234.6, "1235"),
        (123456.7, "123457"),
        (0.001234, "0.00123"),
        (1.5e-7, "1.5e-07"),
        (-2.0, "-2"),
    ],
)
def test_numbers_in_words(value, text):
    assert formats.number(value) == text


def test_small_phrases():
    assert formats.listing([]) == ""
    assert formats.listing(["a"]) == "a"
    assert formats.listing(["a", "b", "c"]) == "a, b and c"
    assert formats.count(0, "run") == "no runs"
    assert formats.count(1, "run") == "1 run"
    assert formats.count(2, "entry", "entries") == "2 entries"
    assert formats.decibels(2.0) == "2 (+6.0 dB)"
    assert formats.decibels(0.0) == "no lower limit"
    assert formats.frequency(2 * np.pi) == "6.28 rad/s (1 Hz)"
    assert formats.sentence("hub: it is") == "hub: it is."
    assert formats.sentence("integrators = 1 accepted") == "integrators = 1 accepted."
    assert formats.sentence("elbow.damping is large") == "elbow.damping is large."
    assert formats.sentence("stop!") == "Stop!"
    assert formats.sentence(" two \n lines ") == "Two lines."
    assert formats.sentence(Markup("<b>x</b> ")) == Markup("<b>x</b>.")
    assert isinstance(formats.sentence(Markup("a")), Markup)


def test_numbers_with_units_and_ranges():
    assert formats.si(1.2345, "N m") == "1.23 N m"
    assert formats.si(2.0, "") == "2"
    assert formats.si(None, "V") == "–"
    assert formats.percent(4.5678, 2) == "4.6 %"
    assert formats.share(0.95) == "95 %"
    assert formats.share(None) == "–"
    assert [formats.portion(value) for value in (-0.2, 0.004, 0.567, 1.01)] == ["0 %", "0 %", "57 %", "100 %"]
    assert formats.signed(-0.125, "%") == "-0.12 %"
    assert formats.extent([2.0, 1.0, 3.0]) == "1 to 3"
    assert formats.extent([1.00001, 1.0]) == "1"
    assert formats.interval((7.6123, 7.6191)) == "7.6123 to 7.6191"
    assert formats.interval((0.0801, 0.1072)) == "0.080 to 0.107"
    assert formats.interval((10.0, 90.0)) == "10 to 90"
    assert formats.interval((0.0, float("inf"))) == "not known"
    assert formats.interval((1.0, 1.0)) == "1 to 1"
    assert formats.interval((1.23456, 2.0), 3) == "1.23 to 2"
    assert [formats.yes_no(state) for state in (True, False, None)] == ["yes", "NO", "–"]
    assert formats.setting({"name": "coulomb", "level_Nm": 0.1, "on": True}) == "level_Nm = 0.1, on = True"
    assert formats.setting((1.0, 2.5)) == "1 to 2.5"


PAGE = """
{% extends "base.html.j2" %}
{% from "macros.html.j2" import section, figure, table, row, remarks with context %}
{% block body %}
{% call section("one", "One", "1") %}
{% call figure("line", values) %}A "caption" of {{ title }}.{% endcall %}
{% call figure("line", values, file="again") %}Again.{% endcall %}
{% call figure("line", []) %}Never drawn.{% endcall %}
{% call table(["a", "b"]) %}{{ row([name, 1.5|number], false) }}{% endcall %}
{{ remarks([name, "  "], "warning") }}{{ remarks([], "good", "No title without items") }}
{% endcall %}
{% endblock %}
"""


@pytest.fixture
def line(monkeypatch):
    """A page and a drawing of this test's own."""

    def draw(values: list[float]) -> Picture | None:
        picture, panel = new_picture(2.0)
        panel.plot(range(len(values)), values)
        return picture if values else None

    environment = shared()
    loader = ChoiceLoader(
        [DictLoader({"test.html.j2": PAGE, "test.txt.j2": "{{ name }}"}), environment.loader]
    )
    monkeypatch.setattr(environment, "loader", loader)
    monkeypatch.setattr(rendering, "drawings", lambda: {"line": draw})


def test_a_template_draws_its_figures_and_escapes_what_it_is_given(line):
    page = rendering.render_page("test.html.j2", title="A<B", name="<script>", values=[1.0, 2.0])
    assert list(page.pictures) == ["line", "line-again"]
    assert page.html.count("<figure>") == 2
    assert "Never drawn" not in page.html
    assert "No title" not in page.html
    assert 'aria-label="A &quot;caption&quot; of A&lt;B."' in page.html
    assert '<tr class="no"><td data-head="a">&lt;script&gt;</td><td data-head="b">1.5</td></tr>' in page.html
    assert '<a href="#one">1</a>' in page.html
    assert page.html.count("<li>") == 1
    assert page.html.count("<script>") == 1  # the page's own


def test_filters_of_one_page_are_not_those_of_the_next(line, monkeypatch):
    filters = (("number", lambda value: f"own {value}"),)
    monkeypatch.setattr(shared(*filters), "loader", shared().loader)
    for own, cell in ((filters, "own 1.5"), ((), "1.5")):
        page = rendering.render_page("test.html.j2", filters=own, title="t", name="n", values=[])
        assert f'<td data-head="b">{cell}</td>' in page.html


def test_texts_are_not_escaped(line):
    assert render_text("test.txt.j2", name="a < b & c") == "a < b & c"


def test_pages_name_every_drawing_that_is_there_and_no_other():
    """In a template, or as the `Picture` of a function."""
    environment, named = shared(), set()
    for template in environment.list_templates(extensions=["j2"]):
        source = environment.loader.get_source(environment, template)[0]
        source = re.sub(r"{#.*?#}", "", source, flags=re.DOTALL)
        named.update(re.findall(r'call figure\("([^"]+)"', source))
    for source in Path(workflow.__file__).parent.rglob("*.py"):
        named.update(re.findall(r'\bPicture\(\s*"([^"]+)"', source.read_text("utf-8")))
    assert named == set(drawings())
    assert all(callable(drawings()[name]) for name in named)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "pycache_prefix", str(tmp_path))
    monkeypatch.setattr(sys, "dont_write_bytecode", False)
    return tmp_path


def said(source, **values):
    environment = Environment(loader=DictLoader({"page": source}), bytecode_cache=CompiledTemplates())
    return environment.get_template("page").render(**values)


def kept(folder):
    return list(folder.rglob("*.template"))


def test_a_template_is_compiled_once(folder, monkeypatch):
    assert said("{{ a }} m", a=1) == "1 m"
    assert len(kept(folder)) == 1
    monkeypatch.setattr(Environment, "compile", lambda *_, **__: pytest.fail("compiled again"))
    assert said("{{ a }} m", a=2) == "2 m"


def test_another_text_is_another_template(folder):
    assert (said("{{ a }} m", a=1), said("{{ a }} s", a=1)) == ("1 m", "1 s")
    assert len(kept(folder)) == 1


@pytest.mark.parametrize(
    "damage", [lambda b: b"", lambda b: b[:-7], lambda b: b[:-1] + b"\0", lambda b: b * 2]
)
def test_a_damaged_file_is_as_none(folder, damage):
    said("{{ a }} m", a=1)
    path = kept(folder)[0]
    whole = path.read_bytes()
    path.write_bytes(damage(whole))
    assert said("{{ a }} m", a=1) == "1 m"
    assert path.read_bytes() == whole


def test_nothing_is_kept_where_nothing_can_be_written(folder):
    (folder / "a file").touch()
    sys.pycache_prefix = str(folder / "a file")
    assert said("{{ a }} m", a=1) == "1 m"
    assert not kept(folder)


def test_a_filter_that_changed_is_asked_again(folder):
    """Of a constant it is asked when the template is compiled."""
    for unit in "mk":
        (folder / "filters.py").write_text(unit)
        made = Environment(
            loader=DictLoader({"page": "{{ 1|with_unit }}"}), bytecode_cache=CompiledTemplates(folder)
        )
        made.filters["with_unit"] = f"{{}} {unit}".format
        assert made.get_template("page").render() == f"1 {unit}"


def test_a_margin_is_never_said_larger_than_it_is():
    assert (formats.margin(70.66), formats.margin(-30.27), formats.margin(150.99)) == ("70.6", "-30.2", "150")
