"""`flexlink paper`: whole files or none, figures that read, sentences that follow the numbers."""

import csv
import json
import math
import os
import re
from dataclasses import replace

import numpy as np
import pytest

from tests.workflow.page_shape import shape_faults
from tests.workflow.test_figures import is_whole, panels
from validation.paper import command
from validation.paper.command import DRAWERS, PAGE, headlines_of, page_html
from validation.paper.experiments import run_experiments
from validation.paper.findings import findings_of
from validation.paper.methods import METHODS
from validation.paper.quotes import OPEN_CHOICES, REPORTED
from validation.paper.settings import PaperSettings
from validation.paper.table import csv_text, rows_of
from workflow.engine.progress import Progress
from workflow.figures.matplotlib_figure import figure_of

pytestmark = pytest.mark.slow

# Everything once, and the searches long enough to find something.
SMALL = PaperSettings(seed=7, repeats=2, searches=1, evaluations=200, surface_points=21, grids=(11, 21))


@pytest.fixture(scope="module")
def results():
    return run_experiments(SMALL, Progress())


@pytest.fixture(scope="module")
def pictures(results):
    return {number: draw(results) for number, draw in DRAWERS.items()}


@pytest.fixture
def ready(monkeypatch, results, pictures):
    """The command with its computation and its pictures done."""
    monkeypatch.setattr(command, "run_experiments", lambda settings, progress: results)
    monkeypatch.setattr(command, "DRAWERS", {number: lambda _, n=number: pictures[n] for number in pictures})


@pytest.mark.parametrize("number", list(DRAWERS))
def test_figures_have_titles_units_and_nothing_is_hidden(results, number):
    figure = figure_of(DRAWERS[number](results))
    for axes in panels(figure):
        for label in filter(None, (axes.get_xlabel(), axes.get_ylabel())):
            assert re.search(r"\[.+\]", label), f"no unit in {label!r}"
    is_whole(figure)


def test_page_stands_alone_and_says_both_sides(results, pictures):
    rows, findings = rows_of(results), findings_of(results)
    page = page_html(results, pictures, findings, rows)
    assert page.count("<figure>") == 7
    assert "--seed 7" in page
    assert re.search(r"\d of 7 figures as the paper reports; not Fig", page)
    assert page.count("<b>Why:</b>") >= sum(not agrees for agrees in findings.agrees.values()) > 0
    assert page.count("The paper reports") == page.count("We find") == 7
    for item in REPORTED:
        assert page.count(item.place) >= 2  # beside the figure and over its table
    for missing, _ in OPEN_CHOICES:
        assert missing in page
    # Nothing is fetched: names of XML dialects are no addresses to load from.
    assert not re.search(r"""(src|href)=["'](?!#|data:)""", page.replace("xlink:href", "href"))
    assert not re.search(r"\bnan\b", page)


@pytest.mark.long
def test_a_browser_shows_the_page_without_a_fault(results, pictures, tmp_path, faults_seen, browser):
    page = page_html(results, pictures, findings_of(results), rows_of(results))
    (tmp_path / "paper.html").write_text(page)
    assert faults_seen(tmp_path / "paper.html") == []
    assert shape_faults(browser, tmp_path / "paper.html", screens=8) == []


def test_sentences_and_rows_are_made_for_every_figure(results):
    findings, rows = findings_of(results), rows_of(results)
    assert len(headlines_of(results, findings)) == len(findings.agrees) == len(REPORTED)
    assert {row.figure for row in rows} == {item.number for item in REPORTED}
    assert len({(row.figure, row.quantity) for row in rows}) == len(rows)
    assert all(row.ours for row in rows)
    assert not any(math.isnan(row.value) for row in rows)


def test_verdicts_follow_the_numbers(results, pictures):
    """The sentence on OE turns when OE finds the mode: no result of ours is written down beforehand."""
    simulation, experiment = results.simulation, results.experiment

    def found_by(shown, names):
        counts = {name: many["trials"] * (name in names) for name, many in shown.medians.items()}
        marks = {name: {**many, "mode_found": counts[name]} for name, many in shown.medians.items()}
        return replace(shown, medians=marks)

    def found(**changes):
        changed = replace(results, **changes)
        return findings_of(changed).agrees, headlines_of(changed, findings_of(changed))

    agrees, headlines = found(simulation=found_by(simulation, ("GOBF", "OE")))
    assert not agrees[3]
    assert headlines[2] == "the mode is usually found by OE"
    assert found(simulation=found_by(simulation, ("GOBF",)))[0][3]
    assert found(experiment=found_by(experiment, ("GOBF", "OE")))[0][4]
    assert not found(experiment=found_by(experiment, METHODS))[0][4]
    runaway = {**experiment.scores, "ARX": replace(experiment.scores["ARX"], fit_percent=-np.inf)}
    away = replace(results, experiment=replace(experiment, scores=runaway))
    assert "ARX runs away" in page_html(away, pictures, findings_of(away), rows_of(away))
    assert any(row.ours == "runs away" for row in rows_of(away))


@pytest.mark.long
def test_the_same_seed_gives_the_same_numbers(results):
    again = run_experiments(SMALL, Progress())
    assert csv_text(rows_of(again)) == csv_text(rows_of(results))


def test_command_writes_the_whole_directory(flexlink, ready, tmp_path):
    out = tmp_path / "deep" / "paper"
    answer = flexlink("paper", "--out", out, "--seed", 7, "--json")
    document = answer.document()
    assert answer.err == ""
    assert document["report"] == str(out / PAGE)
    assert sorted(os.listdir(out)) == sorted(
        [*(f"figure-{n}.svg" for n in range(1, 8)), "lock", "table.csv", "table.json", PAGE]
    )
    assert json.loads((out / "table.json").read_text())["rows"] == document["numbers"]["rows"]
    assert os.listdir(out.parent) == ["paper"]  # no traces beside it
    rows = list(csv.DictReader((out / "table.csv").read_text().splitlines()))
    assert [row["quantity"] for row in rows] == [row["quantity"] for row in document["numbers"]["rows"]]


def test_a_directory_with_something_in_it_is_refused_at_once(refused, monkeypatch, tmp_path):
    monkeypatch.setattr(command, "run_experiments", lambda *_: pytest.fail("computed before looking"))
    (tmp_path / "notes.txt").write_text("mine")
    assert "no redrawn paper" in refused("paper", "--out", tmp_path)
    assert "no redrawn paper" in refused("paper", "--out", tmp_path, "--replace")
    assert "not a directory" in refused("paper", "--out", tmp_path / "notes.txt")
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_replace_exchanges_our_files_and_no_others(flexlink, refused, ready, tmp_path):
    out = tmp_path / "paper"
    assert flexlink("paper", "--out", out).code == 0
    (out / "figure-3.png").write_bytes(b"from another version")
    (out / "notes.txt").write_text("mine")
    (out / PAGE).write_text("an earlier page")
    assert "--replace" in refused("paper", "--out", out)
    assert flexlink("paper", "--out", out, "--replace").code == 0
    assert (out / PAGE).read_text() != "an earlier page"
    assert (out / "notes.txt").read_text() == "mine"
    assert not (out / "figure-3.png").exists()


def test_a_full_disk_leaves_no_page_and_the_next_call_begins_afresh(flexlink, ready, monkeypatch, tmp_path):
    """The page goes first and comes last: none ever stands over other figures."""
    out = tmp_path / "paper"
    assert flexlink("paper", "--out", out).code == 0
    real, seen = os.replace, []

    def full(source, target):
        seen.append((out / PAGE).exists())
        if os.fspath(target).endswith(PAGE):
            raise OSError(28, "No space left on device")
        real(source, target)

    with monkeypatch.context() as patch:
        patch.setattr("workflow.engine.storage.os.replace", full)
        assert "No space left" in flexlink("paper", "--out", out, "--replace").err
    assert len(seen) == 10
    assert not any(seen)
    assert PAGE not in os.listdir(out)
    assert flexlink("paper", "--out", out).code == 0


@pytest.mark.parametrize("change", [{"seed": -1}, {"repeats": 0}, {"evaluations": 5}, {"grids": ()}])
def test_settings_that_make_no_sense_are_refused(change):
    with pytest.raises(ValueError, match="need seed"):
        PaperSettings(**change)
