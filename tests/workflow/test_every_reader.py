"""A fact of a run is worded once: terminal, page, JSON answer, study and Python show the same row."""

import math
import re

import pytest

import flexlink
from tests.workflow.report_examples import build_run, config
from workflow.console import print_summary
from workflow.describe.certificate import margins_by_key
from workflow.describe.facts import by_key
from workflow.describe.loop_metrics import LOOP_METRICS
from workflow.describe.run import run_sections, summarise, with_rows
from workflow.report.pages import write_report
from workflow.study.columns import COLUMNS, numbers_of
from workflow.tasks.results import RunResults
from workflow.text.formats import number


def test_a_number_of_the_step_reaches_every_reader(unbuilt, tmp_path, capsys, monkeypatch):
    settings = config()
    results = RunResults(build_run(tmp_path / "run", settings))
    page = write_report(results, settings).read_text("utf-8")
    summary = summarise(results, settings)
    monkeypatch.setenv("COLUMNS", "300")
    print_summary(summary)
    terminal = capsys.readouterr().out
    answer = summary.to_document()["numbers"]["closed_loop"]
    study = numbers_of(results, settings)
    table = flexlink.table(summary).set_index("key")
    rows = by_key(summary.sections)
    assert "rise_time_s" in [metric.name for metric in LOOP_METRICS]
    for metric in LOOP_METRICS:
        row = rows[f"closed_loop.{metric.name}"]
        of_runs = [getattr(run, metric.name) for run in results.closed_loop.check.achieved]
        assert metric.label in terminal
        assert row.text in terminal
        if metric.name == "rise_time_s":  # the first screen has no room for it: a row of the table below
            cells = "".join(f"<td>{number(value, 4)}</td>" for value in row.value.plain.values())
            assert f"<td>{metric.label} [s]</td>{cells}" in re.sub(r' data-head="[^"]*"', "", page)
        else:
            assert row.value.text in page
            assert row.remark in page
        assert answer[metric.name] == row.value.plain
        assert row.value.plain["largest"] == max(of_runs)
        assert study[metric.name] == max(of_runs)
        assert COLUMNS[metric.name].label == metric.label
        assert table.loc[row.key, "largest"] == max(of_runs)


def test_a_run_has_its_numbers_first_and_the_rest_in_parts(tmp_path):
    settings = config()
    results = RunResults(build_run(tmp_path / "run", settings))
    loop, plant = run_sections(results, settings)
    names = [row.name for row in loop.rows]
    assert names[:5] == ["bandwidth", "modulus margin", "overshoot", "settling time to 2 %", "peak command"]
    assert {part.title for part in loop.parts} >= {"closed loop", "certificate", "design", "controller"}
    assert {part.title for part in plant.parts} >= {"records", "channel hub"}


@pytest.mark.parametrize("taken", [{"modulus_margin": 0.4}, 0.4])
def test_a_key_that_is_there_already_is_refused(tmp_path, taken):
    settings = config()
    results = RunResults(build_run(tmp_path / "run", settings))
    with pytest.raises(ValueError, match="there already"):
        with_rows({"certificate": taken}, run_sections(results, settings))


def test_a_margin_reaches_study_and_answer_by_its_key(unbuilt, tmp_path):
    settings = config()
    results = RunResults(build_run(tmp_path / "run", settings))
    margins = results.certify.certificate.plants[0].worst_margins
    rows = {row.key: row for row in margins_by_key(results.certify.certificate)}
    answer = summarise(results, settings).to_document()["numbers"]["certificate"]
    study = numbers_of(results, settings)
    assert study["modulus_margin"] == margins.modulus
    assert study["phase_margin_deg"] == pytest.approx(math.degrees(margins.phase_rad))
    assert study["worst_gamma"] == answer["worst"]["gamma"]
    for place, prefix in (("worst", ""), ("nominal", "nominal_")):
        for name in ("modulus_margin", "gain_margin_dB", "phase_margin_deg", "delay_margin_ms"):
            value = rows[f"certificate.{place}.{name}"].value.plain
            assert study[prefix + name] == answer[place][name] == value
    assert answer["worst"]["modulus_margin"] != answer["nominal"]["modulus_margin"]
