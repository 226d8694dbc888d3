"""Parts of the study: keys, TOML, ranges, fronts, the picture."""

import math
import os
import re
import signal
import subprocess
import sys
import tomllib
from contextlib import closing
from dataclasses import replace
from multiprocessing import forkserver
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex

from control_design.analysis.margins import Margins
from control_design.convex.reference_filter import ReferenceFilter
from control_design.plants.plant_set import Mode
from control_design.specification import Specification
from tests.workflow.command import FAST_ARM, ROOT, Imported
from tests.workflow.report_examples import (
    achievable,
    build_run,
    config,
    config as example_config,
    loop_check,
    sampled_responses,
)
from workflow.config.run_config import RunConfig, built_in_config, load_config
from workflow.config.settings import check
from workflow.engine.executor import Failure, LocalProcesses
from workflow.engine.run_directory import RunDirectory
from workflow.figures.matplotlib_figure import figure_of
from workflow.figures.style import PREDICTED
from workflow.figures.svg import alone
from workflow.report.rendering import render_described
from workflow.study.columns import COLUMNS, numbers_of
from workflow.study.described import study_page, study_summary
from workflow.study.page import PointRow, StudyView, draw_pareto, pareto_front, row_of
from workflow.study.points import PointMaker, load_base, short
from workflow.study.settings import ParetoPlot, StudyAxis, last_name, load_study, parse_key, tidy, with_values
from workflow.tasks import results as kept


def test_keys_reach_into_tables_and_lists():
    assert parse_key("a.b[2][0].c") == ("a", "b", 2, 0, "c")
    assert last_name("closed_loop.effects[0].mass_kg") == "mass_kg"
    assert last_name("a.levels[1]") == "levels"
    document = {"a": {"b": [{"c": 1}, {"c": 2}]}, "d": None}
    changed = with_values(document, {"a.b[1].c": 5, "d.e": [1]})
    assert changed == {"a": {"b": [{"c": 1}, {"c": 5}]}, "d": {"e": [1]}}
    assert document == {"a": {"b": [{"c": 1}, {"c": 2}]}, "d": None}


@pytest.mark.parametrize(
    ("key", "complaint"),
    [
        ("a..b", "not a dotted key"),
        ("a.b[x]", "not a dotted key"),
        ("a.b[7].c", r"a\.b\[7\]\.c: a\.b has 1 entries"),
        ("a.n.c", r"a\.n is no table"),
        ("a[0]", "a is no list"),
    ],
)
def test_keys_that_lead_nowhere(key, complaint):
    with pytest.raises(ValueError, match=complaint):
        with_values({"a": {"b": [{}], "n": 3}}, {key: 1})


@pytest.mark.parametrize("name", ["default", "fast"])
def test_configurations_come_back_from_toml(name):
    config, _ = built_in_config() if name == "default" else load_config(FAST_ARM)
    document = tomllib.loads(config.to_toml())
    assert check(RunConfig, document, source="again", context={"may_be_gone": True}) == config


def _axis(**keys) -> StudyAxis:
    return StudyAxis.model_validate({"key": "specification.bandwidth_rad_s", **keys})


def test_ranges():
    assert _axis(**{"from": 1, "to": 4}).grid() == (1, 2, 3, 4)
    assert _axis(**{"from": 1.0, "to": 2.0, "points": 3}).grid() == (1.0, 1.5, 2.0)
    assert _axis(**{"from": 0.1, "to": 10.0, "points": 3, "log": True}).grid() == (0.1, 1.0, 10.0)
    assert _axis(**{"from": 1, "to": 100, "points": 3, "log": True}).grid() == (1, 10, 100)
    assert _axis(values=[3, "x"]).grid() == (3, "x")
    assert tidy(0.12345678) == 0.123457


def test_names_of_values():
    assert [short(v) for v in (0.1 + 0.2, 4, True, [1.0, 2.5], {"a": 1.0})] == [
        "0.3",
        "4",
        "True",
        "[1, 2.5]",
        "{a = 1}",
    ]


def _row(number: int, bandwidth: float | None, margin: float | None, good: bool = True) -> PointRow:
    numbers = dict.fromkeys(COLUMNS) | {"bandwidth_rad_s": bandwidth, "modulus_margin": margin}
    return PointRow(number, str(number), {}, "certified" if good else "not certified", "", numbers)


_PLOT = ParetoPlot(x="bandwidth_rad_s", y="modulus_margin")


def test_front_of_a_known_set():
    rows = [
        _row(1, 1.0, 0.9),
        _row(2, 2.0, 0.8),
        _row(3, 2.0, 0.7),  # beaten by 2
        _row(4, 3.0, 0.5),
        _row(5, 9.0, 0.95, good=False),  # nothing is promised there
        _row(6, None, 0.99),
        _row(7, 3.0, 0.5),  # as good as 4: neither beats the other
    ]
    assert pareto_front(rows, _PLOT) == [1, 2, 4, 7]


def test_smaller_is_better_where_it_says_so():
    assert COLUMNS["worst_gamma"].badness(0.9) < COLUMNS["worst_gamma"].badness(1.1)
    assert COLUMNS["modulus_margin"].badness(0.9) < COLUMNS["modulus_margin"].badness(0.5)


def design_of(gamma):
    """A design of this gamma: nothing else of it is looked at."""
    return kept.DesignResult(SimpleNamespace(gamma=gamma), met=False, reason="")


def test_margins_in_the_units_of_the_table():
    margins = Margins(gain_up=4.0, gain_down=0.5, phase_rad=1.0, delay_s=math.inf, modulus=0.4)
    verdict = SimpleNamespace(
        worst_margins=margins,
        nominal_margins=replace(margins, gain_down=0.0),
        bandwidth_rad_s=3.0,
        closed_loop_modes=(Mode(40.0, 0.2), Mode(200.0, 0.1)),
    )
    certificate = SimpleNamespace(plants=(verdict,), gamma=math.inf, gamma_bound=None)
    certify = kept.CertifyResult(certificate, certified=False, reason="")
    results = SimpleNamespace(
        design=design_of(0.8),
        achievable_performance=kept.AchievablePerformance(),
        certify=certify,
        reference_filter=kept.ReferenceFilterResult(),
        closed_loop=kept.ClosedLoopResult(skipped="why not"),
    )
    asked = RunConfig.model_construct(specification=SimpleNamespace(mode_band_rad_s=(30.0, 100.0)))
    found = numbers_of(results, asked)
    assert found["gain_margin_dB"] == pytest.approx(6.0206, abs=1e-4)  # down to a half: the nearer side
    assert found["nominal_gain_margin_dB"] == pytest.approx(12.0412, abs=1e-4)
    assert found["phase_margin_deg"] == pytest.approx(57.29578)
    assert found["delay_margin_ms"] is None
    assert found["worst_gamma"] is None
    assert (found["mode_damping"], found["mode_omega_rad_s"]) == (0.2, 40.0)
    assert (found["design_gamma"], found["any_order_gamma"], found["matching_error"]) == (0.8, None, None)
    results.design = kept.DesignResult(None, met=False, reason="")
    asked.specification.mode_band_rad_s = None
    assert numbers_of(results, asked)["mode_damping"] == 0.1


def test_numbers_beyond_the_margins():
    filtered = ReferenceFilter(
        np.array([[0.9]]), np.array([[0.1]]), np.array([[1.0]]), np.array([[0.0]]), 0.01, 0.95, 0.2, 3.0
    )
    peaks = SimpleNamespace(
        nominal_peak=1.4, measured=(SimpleNamespace(peak=1.42), SimpleNamespace(peak=1.1))
    )
    slow = SimpleNamespace(settling=kept.SettlingRange((0.1, 0.2), (4.0, 2.0), 30.0), sticking_step=0.0)
    check = replace(loop_check(config(), settled=1, draws=2), sensitivity=peaks, friction=slow)
    results = SimpleNamespace(
        design=design_of(0.88),
        achievable_performance=achievable(0.8),
        certify=kept.CertifyResult(None, certified=False, reason="", sampled=sampled_responses(0.9)),
        reference_filter=kept.ReferenceFilterResult(filtered),
        closed_loop=kept.ClosedLoopResult(check=check),
    )
    found = numbers_of(
        results, RunConfig.model_construct(specification=SimpleNamespace(mode_band_rad_s=None))
    )
    assert found["any_order_gamma"] == 0.8
    assert found["above_any_order_percent"] == pytest.approx(10.0)
    assert (found["whole_held_percent"], found["whole_stable_percent"]) == (99.0, 100.0)
    assert (found["matching_error"], found["matching_error_unfiltered"]) == (0.2, 0.95)
    for name in ("settling_time_s", "rise_time_s", "overshoot_percent", "peak_command", "disturbance_peak"):
        assert found[name] == max(getattr(run, name) for run in check.achieved), name
    assert found["settling_time_with_friction_s"] == 4.0
    assert (found["predicted_peak_sensitivity"], found["measured_peak_sensitivity"]) == (1.4, 1.42)


def _view(rows: list[PointRow], plots: int = 1) -> StudyView:
    config: Any = SimpleNamespace(axes=(), pareto=(_PLOT,) * plots)
    return StudyView("a study", config, "", "", rows, {})


def test_picture_tells_certified_from_uncertified():
    rows = [_row(1, 1.0, 0.9), _row(2, 1.0, 0.5), _row(3, 2.0, 0.9, good=False), *[_row(4, None, 0.9)] * 2]
    picture = draw_pareto(_view(rows))
    axes = figure_of(picture).axes[0]
    by_label = {line.get_label(): line for line in axes.lines}
    assert to_hex(by_label["certified, on the front"].get_color()) == PREDICTED.lower()
    assert by_label["not certified, or does not settle"].get_markerfacecolor() == "none"
    assert list(by_label["certified, dominated"].get_xdata()) == [1.0]
    texts = [text.get_text() for text in axes.texts]
    assert "1" in texts
    assert "2 not drawn: no number here" in texts
    assert b"2 not drawn: no number here" in alone(picture)


def test_an_axis_over_the_bandwidth_is_no_question_of_a_lower_one(tmp_path):
    base = tmp_path / "base.toml"
    text = FAST_ARM.read_text()
    asked = re.search(r"^bandwidth_rad_s = (.+)$", text, re.MULTILINE)
    base.write_text(text.replace(asked[0], f"{asked[0]}\nlowest_bandwidth_rad_s = 0.2"))
    axis = '[[axes]]\nkey = "specification.{}"\nvalues = [{}]\n'
    width, order = axis.format("bandwidth_rad_s", "0.1, 1.0"), axis.format("controller_order", "4")
    lowest = axis.format("lowest_bandwidth_rad_s", "0.05")
    found = {}
    for axes in (width, order, width + lowest):
        (tmp_path / "study.toml").write_text(f'[study]\nbase = "base.toml"\n{axes}')
        file = load_study(tmp_path / "study.toml")
        made = load_base(file.config, file.path, file.base)
        points = PointMaker(file.config, file.path, made).grid()
        lowest_of = [point.config.specification.lowest_bandwidth_rad_s for point in points]
        found[axes] = made.left_out, lowest_of
    assert found == {
        width: ({"lowest_bandwidth_rad_s": 0.2}, [None, None]),
        order: ({}, [0.2]),
        width + lowest: ({}, [0.05, 0.05]),
    }


def test_a_point_at_a_lower_bandwidth_is_marked_everywhere():
    numbers = dict.fromkeys(COLUMNS) | {
        "bandwidth_rad_s": 5.7, "modulus_margin": 0.6, "worst_gamma": 0.8, "design_bandwidth_rad_s": 4.0
    }  # fmt: skip
    why = "bandwidth_rad_s = 9 was not met; designed for 4 rad/s"
    lower = PointRow(1, "a", {}, "certified at a lower bandwidth", why, numbers)
    whole = replace(lower, number=2, state="certified", why="certified")
    axes = StudyAxis.model_validate(
        {"key": "specification.modulus_margin", "label": "asked", "values": [0.5]}
    )
    for rows, config_axes, judged in (
        ([lower, whole], (), False),
        ([whole, whole], (), True),
        ([replace(whole, values={axes.key: 0.5})], (axes,), False),
    ):
        view = replace(_view(rows), config=SimpleNamespace(axes=config_axes, pareto=(_PLOT,)))
        assert ("worst_gamma" in [column.name for column, _ in view.best]) == judged
    view = replace(_view([lower, whole]), left_out={"lowest_bandwidth_rad_s": 1.6})
    axes = figure_of(draw_pareto(view)).axes[0]
    ring = {line.get_label(): line for line in axes.lines}["certified at a lower bandwidth than specified"]
    assert list(ring.get_xdata()) == [5.7]
    page = render_described(study_page(view)).html
    assert "2 of 2 points certified, 1 of them at a lower bandwidth than specified" in page
    assert f"Point 1 (certified at a lower bandwidth): {why}" in page
    assert "bandwidth of the design [rad/s]" in page
    assert "lowest_bandwidth_rad_s = 1.6 of the base is left out" in page
    told = [row.text for section in study_summary(view, "").sections for row in section.rows]
    assert any("lowest_bandwidth_rad_s = 1.6 of the base is left out" in value for value in told)
    assert any(value.startswith("certified at a lower bandwidth") for value in told)


def test_picture_of_nothing_is_drawn():
    assert alone(draw_pareto(_view([_row(1, None, None)] * 3, 3))).count(b"3 not drawn") == 3


class Deadly:
    """Kills the process that unpacks it, as a crash in compiled code would."""

    def __reduce__(self):
        return os._exit, (1,)


@pytest.mark.slow
def test_a_task_that_kills_its_process_fails_alone():
    harmless = Imported(("workflow",))
    deadly = Imported((Deadly(),))
    before = os.environ.get("OMP_NUM_THREADS")
    with closing(LocalProcesses(2)) as processes:
        found = dict(processes.run([harmless, deadly, harmless, harmless]))
    assert os.environ.get("OMP_NUM_THREADS") == before
    assert found.keys() == {0, 1, 2, 3}
    assert isinstance(found[1], Failure)
    assert "3 times" in found[1].reason
    assert found[0] == found[2] == found[3] == harmless.run(None)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked off another one on Linux only")
def test_the_process_that_others_are_forked_off_may_die_too(monkeypatch):
    """A task, another one when that process has just been killed, and one whose start meets a dead one."""
    here = Imported(("workflow",)).run(None)
    with closing(LocalProcesses(1)) as processes:
        found = processes.run([Imported(("workflow",))] * 3)
        assert next(found)[1] == here
        # It does not see interrupts from the keyboard, not while it loads either.
        status = Path(f"/proc/{forkserver._forkserver._forkserver_pid}/status").read_text()
        assert int(status.partition("SigBlk:")[2].split()[0], 16) & 1 << (signal.SIGINT - 1)
        os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)
        assert next(found)[1] == here
        ensure_running = forkserver._forkserver.ensure_running

        def dead_at_once() -> None:
            ensure_running()
            os.kill(forkserver._forkserver._forkserver_pid, signal.SIGKILL)
            monkeypatch.undo()

        monkeypatch.setattr(forkserver._forkserver, "ensure_running", dead_at_once)
        assert next(found)[1] == here


_INTERRUPTED = """
import signal, sys
from workflow.engine import interrupts
from workflow.engine.executor import Failure, LocalProcesses
from workflow.engine.run_directory import RunDirectory

class Large:
    def __init__(self):
        self.content = bytes(10**6)  # more than a pipe holds: sending it waits until a process reads

if __name__ == "__main__":
    interrupts.watch()
    interrupts.limit(0.5)
    try:
        list(LocalProcesses(1, preload=["loads_long"]).run([Large()]))
    except KeyboardInterrupt:
        sys.exit(interrupts.exit_code())
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked off another one on Linux only")
def test_an_interrupt_while_a_process_begins_is_no_traceback(tmp_path):
    script = tmp_path / "interrupted.py"
    script.write_text(_INTERRUPTED)
    (tmp_path / "loads_long.py").write_text("import time; time.sleep(2)")
    path = os.pathsep.join([str(tmp_path), str(ROOT)])
    ended = subprocess.run(
        [sys.executable, str(script)],
        capture_output=True,
        timeout=60,
        env=os.environ | {"PYTHONPATH": path},
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (128 + signal.SIGALRM, b"")


def test_tables_show_what_was_asked_for_and_no_empty_column():
    axis = StudyAxis.model_validate(
        {"key": "specification.bandwidth_rad_s", "label": "asked", "values": [1.0]}
    )
    numbers = dict.fromkeys(COLUMNS) | {
        "worst_gamma": 0.9, "any_order_gamma": 0.8, "predicted_peak_sensitivity": 1.4,
        "measured_peak_sensitivity": 1.42, "settled_draws": 1, "draws": 2,
    }  # fmt: skip
    row = PointRow(1, "a", {axis.key: 1.0}, "keeps moving", "why", numbers)
    config: Any = SimpleNamespace(axes=(axis,), pareto=())
    view = StudyView("a study", config, "[study]", "the arm", [row], {})
    page = render_described(study_page(view)).html
    tables = re.findall(r"<thead>(.*?)</thead>\s*<tbody>(.*?)</tbody>", page, re.DOTALL)
    heads = [re.findall(r"<th[^>]*>(.*?)</th>", head) for head, _ in tables]
    rows = [re.findall(r"<td[^>]*>(.*?)</td>", body) for _, body in tables]
    assert heads[0] == ["point", "asked", "worst-case gamma", "gamma of any order", "state"]
    point = '<a href="points/a/">1</a>'
    assert rows[0] == [point, "1", "0.9", "0.8", "keeps moving"]
    assert heads[1] == ["point", "asked", "peak of S, predicted", "peak of S, measured", "stop moving"]
    assert rows[1] == [point, "1", "1.4", "1.42", "1 of 2"]
    assert all('<tr class="no">' in body for _, body in tables)


@pytest.mark.parametrize(("offset", "state"), [(0.0, "certified"), (0.05, "does not settle")])
def test_a_loop_at_rest_beside_its_reference_does_not_settle(offset, state, tmp_path):
    """Three runs at rest, of which the last stays a tenth of the step away."""
    run = build_run(tmp_path / "run", example_config(), settled=3)
    found = kept.RunResults(run)
    check = found.closed_loop.check
    times = (0.5, 0.6, None if offset else 0.7)
    achieved = tuple(
        replace(row, settled=True, settling_time_s=time)
        for row, time in zip(check.achieved, times, strict=True)
    )
    run.save_stage("closed_loop", kept.ClosedLoopResult(check=replace(check, achieved=achieved)), "00")
    run.save_stage("certify", replace(found.certify, certified=True), "00")
    designed_for = Specification(bandwidth_rad_s=1.0)
    run.save_stage("design", replace(found.design, specification=designed_for), "00")
    point: Any = SimpleNamespace(
        number=1,
        name="1",
        values={},
        config=example_config().model_copy(update={"specification": designed_for}),
    )
    row = row_of(point, RunDirectory.open(tmp_path / "run"))
    assert (row.state, row.good) == (state, state == "certified")
    assert ("1 of 3 runs never settle" in row.why) == (offset > 0)
    lower_one = Specification(bandwidth_rad_s=9.0, lowest_bandwidth_rad_s=0.1)
    point.config = point.config.model_copy(update={"specification": lower_one})
    lower = row_of(point, RunDirectory.open(tmp_path / "run"))
    assert lower.state == ("does not settle" if offset else "certified at a lower bandwidth")
    assert lower.why.startswith("bandwidth_rad_s = 9 was not met")
    assert lower.numbers["design_bandwidth_rad_s"] == 1.0
    view = _view([row, replace(row, number=2, state="certified")])
    assert [each.number for each in view.in_order] == ([2, 1] if offset else [1, 2])
    assert view.best == [] or all(best.good for _, best in view.best)
