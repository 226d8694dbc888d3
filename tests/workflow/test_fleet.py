"""Many machines at once: groups, trends, table, workers that die."""

from __future__ import annotations

import csv
import io
import os
import signal

import numpy as np
import pytest

from benchmarks.fleet import write_fleet
from tests.workflow.command import finish, start_flexlink, wait_until
from tests.workflow.test_study_cluster import cluster  # noqa: F401
from workflow.diagnose import fleet


def machine(name: str, level: float | None = None, value: float = 1.0, **more) -> fleet.Machine:
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
    return fleet.Machine(name, sizes=sizes, **{**stated, **more})


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


@pytest.mark.slow
def test_a_worker_killed_midway_changes_no_byte(cluster, tmp_path):  # noqa: F811
    call = ("diagnose", *write_fleet(tmp_path / "cases", 8, samples=150))
    finish(start_flexlink(*call, "--out", tmp_path / "near", "--jobs", "2"))
    cluster.add_worker()
    cluster.add_worker()
    process = start_flexlink(*call, "--out", tmp_path / "far", "--scheduler", cluster.address)
    wait_until(lambda: any((tmp_path / "far").glob("unit-*.json")), process)
    os.kill(cluster.workers[0].pid, signal.SIGKILL)
    finish(process)
    near, far = (
        {
            path.name: path.read_bytes()
            for path in (tmp_path / where).iterdir()
            if path.name not in ("timings.json", "lock")
        }
        for where in ("near", "far")
    )
    assert len(far) > 8
    assert near == far
