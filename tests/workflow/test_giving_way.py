"""What gave way is said beside its requirement, on the page and on the terminal."""

from control_design import Specification
from control_design.specification.specification import Effort, ModePeak, Tracking
from workflow.describe.design import gave_way_beside, gave_way_text
from workflow.tasks.giving_way import gave_way

_ASKED = Specification(
    bandwidth_rad_s=10.0,
    lowest_bandwidth_rad_s=1.0,
    effort_limit=2.2,
    highest_effort_limit=8.8,
    mode_peak_ratio=1.0,
    highest_mode_peak_ratio=2.0,
)


def test_what_gave_way_is_told_with_both_values_beside_its_line():
    used = Specification(bandwidth_rad_s=1.0, effort_limit=2.31, mode_peak_ratio=1.0)
    found = gave_way(_ASKED, used)
    assert [(one.key, one.asked, one.used, one.limit) for one in found] == [
        ("bandwidth_rad_s", 10.0, 1.0, 1.0),
        ("effort_limit", 2.2, 2.31, 8.8),
    ]
    # The bandwidth has words of its own (`lowered`).
    assert gave_way_text(found) == "effort_limit = 2.31 in place of 2.2"
    beside = {name: gave_way_beside(name, found) for name in (Tracking.caption, ModePeak.caption)}
    assert beside == {
        Tracking.caption: "(bandwidth_rad_s gave way: 1 in place of 10)",
        ModePeak.caption: "",
    }
    assert "2.31 in place of 2.2" in gave_way_beside(Effort.caption, found)


def test_what_is_as_asked_or_hard_gave_no_way():
    as_asked = Specification(bandwidth_rad_s=10.0, effort_limit=2.2, mode_peak_ratio=1.0)
    assert gave_way(_ASKED, as_asked) == ()
    assert gave_way(_ASKED, None) == ()
    other = Specification(bandwidth_rad_s=5.0, effort_limit=9.0)
    assert gave_way(Specification(bandwidth_rad_s=10.0, effort_limit=2.2), other) == ()
    assert gave_way_text(()) == ""
