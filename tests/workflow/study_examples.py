"""A small study on the fast arm, and ways to run it: six points, two of them impossible, some seconds."""

from pathlib import Path

from tests.workflow.command import FAST_ARM

SMALL_STUDY = f"""
[study]
title = "small"
base = "{FAST_ARM}"

[changes]
"achievable_performance.compute" = false
"closed_loop.draws" = 2
"closed_loop.conditions" = false
"closed_loop.sensitivity" = false

[[axes]]
key = "specification.bandwidth_rad_s"
label = "asked"
values = [1.0, 1.5, 1e5]

[[axes]]
key = "closed_loop.effects"
label = "effects"
values = [[], [{{ name = "tip_payload", mass_kg = 0.02 }}]]
"""

# What every other study starts from: one draw of the fast arm, and nothing more.
PLAIN = f"""
[study]
base = "{FAST_ARM}"
[changes]
"achievable_performance.compute" = false
"closed_loop.draws" = 1
"closed_loop.conditions" = false
"closed_loop.sensitivity" = false
"""

TWO_POINTS = f"""{PLAIN}
[[axes]]
key = "specification.bandwidth_rad_s"
values = [1.0, 1.5]
"""


def write_study(folder: Path, text: str = SMALL_STUDY) -> Path:
    """The study as a file in `folder`."""
    path = folder / "study.toml"
    path.write_text(text)
    return path


def point_bytes(study: Path) -> dict[str, bytes]:
    """Every stage file of every point."""
    return {
        path.relative_to(study).as_posix(): path.read_bytes()
        for path in sorted((study / "points").glob("*/stages/*"))
        if path.name[0] != "."
    }


def assert_same_study(left: Path, right: Path) -> None:
    """Equal tables and equal stage files, byte for byte."""
    assert (left / "table.csv").read_bytes() == (right / "table.csv").read_bytes()
    assert (left / "table.json").read_bytes() == (right / "table.json").read_bytes()
    first, second = point_bytes(left), point_bytes(right)
    assert first.keys() == second.keys()
    for name, content in first.items():
        assert second[name] == content, f"{name} differs"
