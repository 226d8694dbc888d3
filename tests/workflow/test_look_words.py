"""What is said of a log follows from what was seen in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from markupsafe import Markup

from diagnosis.machine.telling import Alike, Telling
from ident.data.roles import Roles
from workflow.describe.check import Candidates, LogSeen, check_sections
from workflow.look.log_look import ColumnLook, LogLook, ResponseLook, TimeLook
from workflow.look.words import (
    look_page,
    look_sections,
    response_words,
    sampling_words,
    signal_words,
)

TIME = TimeLook("t_s", "s", period_s=0.005)
COLUMN = ColumnLook("y_rad", "rad", np.array([-1.0, 0.0, 2.0]))
LOG = LogLook(Path("a <b>.csv"), 3, None, TIME, (COLUMN,), None, "")


@pytest.mark.parametrize(
    ("seen", "said", "not_said"),
    [
        ({}, "every 5 ms (200 Hz), read in seconds; no jitter; no row missing", "grid"),
        ({"period_s": 2.0}, "every 2 s (0.5 Hz)", "ms"),
        ({"jitter": 0.2}, "jitter 20 % of a step; no row missing", "grid"),
        ({"jitter": 0.21}, "on no uniform grid", "no row missing"),
        ({"jitter": 0.1, "rounded": True}, "rounded to their last digit", "jitter"),
        (
            {"missing": 2, "gap_s": 0.02, "gap_place": "row 7"},
            "2 rows missing, the largest step 0.02 s",
            "no row",
        ),
        ({"option": "split"}, "split the file there", "identify"),
        ({"option": "--repair"}, "identify with --repair", "split"),
        ({"why": "it falls"}, "not usable: it falls", "every"),
    ],
)
def test_a_column_of_time_is_described_by_what_it_lacks(seen, said, not_said):
    words = sampling_words(replace(TIME, **seen))
    assert said in words
    assert not_said not in words


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        ({}, "-1 to 2 rad"),
        ({"unit": ""}, "no unit in the name"),
        ({"values": np.ones(3)}, "stands still"),
        ({"step": 0.002}, "steps of 0.002 rad"),
        ({"clipped": 0.25}, "25 % of the samples stand at the limit"),
        ({"values": None, "why": "text in line 3"}, "text in line 3"),
    ],
)
def test_a_signal_is_described_by_its_numbers(seen, said):
    assert said in signal_words(replace(COLUMN, **seen))


@pytest.mark.parametrize(
    ("seen", "said"),
    [
        ({"points": 70, "frequencies": 70}, "spread is not known"),
        ({"points": 140, "frequencies": 70}, "spread is known"),
        ({"points": 70, "frequencies": 70, "spread": True}, "with variances"),
        ({"why": "no phase"}, "not understood: no phase"),
    ],
)
def test_a_response_says_whether_its_spread_is_known(seen, said):
    assert said in response_words(replace(ResponseLook(low_Hz=1.0, high_Hz=40.0), **seen))


@pytest.mark.parametrize(("reference", "all_logs"), [("r_rad", True), (None, False)])
def test_all_logs_are_asked_for_of_a_closed_loop(reference, all_logs):
    found = replace(LOG, roles=Roles(input="u_V", output="y_rad", reference=reference, time="t_s"))
    titles = [section.title for section in look_sections(found)]
    assert ("next" in titles) == all_logs
    page = look_page(found, "a <b>.csv: which is it?; type: flexlink run a.csv")
    assert ("all logs of the machine" in page.first.bullets[0]) == all_logs
    # The command is markup; what comes from a name of a file is not.
    assert isinstance(page.first.bullets[0], Markup)
    assert "<code>flexlink run a.csv</code>" in page.first.bullets[0]
    assert "<b>" not in page.first.bullets[0]


def rows(**changes) -> dict[str, dict[str, str]]:
    log = LogSeen("swing", "held_out", 200, (("x", 1.9, 0.1), ("y", 2.0, 0.1)), {"u": 1.0, "v": 0.4})
    stated = {"logs": (log,), "doubts": (), "advice": (), "groups_left_out": 0, **changes}
    telling = stated.pop("telling", Telling({}, (), ()))
    candidates = Candidates({"drag": "force_N"}, {"mass": (2.0, "mass_kg")}, ("limit",), {"lag": "a step"})
    sections = check_sections(dt_s=0.01, units={"x": "m"}, telling=telling, candidates=candidates, **stated)
    return {section.title: {row.name: row.text for row in section.rows} for section in sections}


def test_a_log_with_little_motion_or_a_dead_command_is_doubted():
    log = rows()["swing"]
    assert log["samples"] == "200 every 10 ms, validation"
    assert ("little of it is motion" in log["x"], "little of it is motion" in log["y"]) == (True, False)
    assert log["u"] == "never changes"
    assert "40 % of the time" in log["v"]


def test_sizes_are_said_in_their_units_and_of_values_as_shares():
    telling = Telling({"drag": 0.3, "mass": 0.05, "lag": np.inf}, ("lag",), (Alike(("drag", "mass"), 0.1),))
    found = rows(telling=telling)
    assert found["smallest size that shows"] == {"drag": "force 0.3 N", "mass": "5 % of 2 kg"}
    assert found["does not show"]["lag"] == "does nothing in these records"
    assert found["does not show"]["not tried"] == "lag: needs a step"
    assert found["look alike, if present"]["drag"] == "mass reproduces 90 % of its effect"


def test_a_long_list_says_how_long_it_is():
    telling = Telling({f"effect_{k}": 1.0 for k in range(25)}, tuple(f"effect_{k}" for k in range(3)), ())
    candidates = {f"effect_{k}": "force_N" for k in range(25)}
    sections = check_sections(
        (), 0.01, {}, (), telling, Candidates(candidates, {}, (), {}), (), groups_left_out=2
    )
    shows, _, alike = (section.rows for section in sections)
    assert (len(shows), shows[-1].text) == (21, "22 candidates in the JSON answer")
    assert alike[-1].text == "2 groups in the JSON answer"
