"""Many machines at once: groups, trends, table."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from workflow.describe.summary import RunSummary
from workflow.diagnose import command, fleet
from workflow.engine import codec
from workflow.engine.executor import Failure
from workflow.report.rendering import render_described


def machine(name: str, level: float | None = None, value: float = 1.0, **more) -> fleet.FleetMachine:
    sizes = {} if level is None else {("elbow.frictionloss", "level_Nm"): (level, 0.9 * level, 1.1 * level)}
    stated = {
        "verdict": "none" if level is None else "effect",
        "decided": True,
        "effects": tuple(sorted({effect for effect, _ in sizes})),
        "answer": "no model error" if level is None else "elbow.frictionloss",
        "closed": "",
        "numbers": dict.fromkeys(fleet._NUMBERS, 1.0),
        "values": {"elbow.damping": (1.0, value)},
    }
    return fleet.FleetMachine(name, sizes=sizes, **{**stated, **more})


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["arm-3", "arm-11"], {"arm-3": 3, "arm-11": 11}),
        (["line2_unit001", "line2_unit002"], {"line2_unit001": 1, "line2_unit002": 2}),
        (["2024-07", "2024-08", "spare"], {"2024-07": 7, "2024-08": 8}),
        (["left", "right"], {}),
        (["arm-3"], {}),
        ([], {}),
    ],
)
def test_the_number_of_a_name(names, found):
    assert fleet.serial_numbers(names) == found


def test_a_size_that_grows_with_the_number_is_a_trend_in_any_order_of_cases():
    rng = np.random.default_rng(3)
    units = [machine(f"unit-{k:03d}", 0.1 + 0.02 * k + 0.01 * rng.standard_normal()) for k in range(12)]
    rng.shuffle(units)
    (one,) = fleet.trends(units)
    assert (one.effect, one.parameter, one.machines) == ("elbow.frictionloss", "level_Nm", 12)
    assert one.tau > 0.8
    assert abs(one.per_number - 0.02) < 0.003
    # An effect that only the later ones have grows from nothing; so does a value that was re-estimated.
    late = [machine(f"unit-{k}", None if k < 6 else 0.1 * k) for k in range(14)]
    assert [one.tau > 0 for one in fleet.trends(late)] == [True]
    falling = [machine(f"unit-{k}", value=1 - 0.03 * k) for k in range(9)]
    assert [(one.effect, one.parameter, one.tau < 0) for one in fleet.trends(falling)] == [
        ("", "elbow.damping", True)
    ]


def test_scatter_few_machines_and_undecided_ones_are_no_trend():
    rng = np.random.default_rng(4)
    false = 0
    for _ in range(200):
        units = [machine(f"{k}", rng.lognormal(), rng.lognormal()) for k in range(15)]
        false += len(fleet.trends(units))
    assert false <= 7  # of 200 overviews at 1 %: more than 7 with probability 0.1 %
    assert fleet.trends([machine(f"{k}", 0.1 * k + 0.1) for k in range(5)]) == []
    assert fleet.trends([machine(f"{k}", 0.1 * k + 0.1, decided=k > 3) for k in range(9)]) == []


def test_groups_and_table_have_every_machine():
    units = [machine("unit-1", 0.1), machine("unit-2"), machine("unit-3", 0.3), machine("unit-4", 0.5)]
    first, second = fleet.groups(units)
    assert [one.name for one in first.machines] == ["unit-1", "unit-3", "unit-4"]
    assert first.sizes == {("elbow.frictionloss", "level_Nm"): (0.3, 0.1, 0.5)}
    assert (len(second.machines), second.sizes) == (1, {})
    sure, unsure = machine("unit-1", 0.1), machine("unit-2", 0.2, answer="elbow.frictionloss (ambiguous)")
    assert len(fleet.groups([sure, unsure])) == 1
    rows = list(csv.DictReader(io.StringIO(fleet.csv_text(units, {"unit-9": 'no log "a", really'}))))
    assert [row["case"] for row in rows] == ["unit-1", "unit-2", "unit-3", "unit-4", "unit-9"]
    assert [row["elbow.frictionloss.level_Nm"] for row in rows] == ["0.1", "", "0.3", "0.5", ""]
    assert rows[2]["elbow.damping (repaired)"] == "1.0"
    assert rows[4]["answer"] == 'no log "a", really'


def test_machines_of_one_cause_come_apart_where_their_sizes_have_a_gap():
    rng = np.random.default_rng(5)
    light, heavy, bent = (
        [machine(f"{what}-{k}", level * rng.lognormal(0.0, 0.05)) for k in range(count)]
        for what, level, count in (("light", 0.1, 7), ("heavy", 0.4, 5), ("bent", 3.0, 4))
    )
    every = [*bent, *light, machine("right-1"), *heavy]
    rng.shuffle(every)
    found = fleet.groups(every)
    parts = [{one.name.split("-")[0] for one in group.machines} for group in found]
    assert parts == [{"light"}, {"heavy"}, {"bent"}, {"right"}]
    assert [len(group.machines) for group in found] == [7, 5, 4, 1]
    size = ("elbow.frictionloss", "level_Nm")
    assert [group.apart for group in found] == [size, size, size, None]
    page = render_described(fleet.overview_page(every, {})).html
    assert all(f"level {group.sizes[size][1]:.3g} N m to" in page for group in found[:3])
    # Of negative sizes the same, and a size that only some have sets nothing apart.
    tilted = [machine(f"{k}", -level) for k, level in enumerate([1, 1.1, 1.05, 9, 9.5, 9.2])]
    assert [len(group.machines) for group in fleet.groups(tilted)] == [3, 3]
    tilted[0] = replace(tilted[0], sizes={("elbow.frictionloss", "other"): (1.0, 0.0, 0.0)})
    assert [len(group.machines) for group in fleet.groups(tilted)] == [6]


@pytest.mark.parametrize("count", [6, 12, 40, 300])
def test_machines_that_scatter_about_one_size_stay_together(count):
    rng, apart = np.random.default_rng(6), 0
    for k in range(300):
        draw = (rng.lognormal, rng.uniform, rng.standard_normal)[k % 3]
        apart += len(fleet.groups([machine(f"{j}", float(draw())) for j in range(count)])) > 1
    assert apart <= 9  # of 300 overviews at 1 %: more than 9 with probability 0.1 %


def test_answers_are_written_one_after_another():
    class Answers(list):
        """Counts what was read."""

        read = 0

        def __iter__(self):
            for one in super().__iter__():
                self.read += 1
                yield one

    for count in (0, 1, 3):
        answers = Answers({"case": f"ä{k}", "list": [1, {"x": None}], "empty": []} for k in range(count))
        failures = (("bad", Failure("no log", bad_input=True)),)
        run = command.DiagnosisRun(answers, failures, RunSummary("t", (), report_path="index.html"))
        failed = [{"case": "bad", "reason": "no log"}]
        whole = {"cases": list(answers), "failed": failed, "report": "index.html"}
        assert "".join(run.json_parts()) == codec.plain_text(whole)
        assert "".join(run.json_parts(ascii_only=True)) == codec.plain_text(whole, ascii_only=True)
        answers.read, parts = 0, run.json_parts()
        for k in range(count):
            assert next(parts).count('case"') == 1
            assert answers.read == k + 1
