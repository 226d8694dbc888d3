"""Regression test on closed-loop margins: the examples, end to end, against `tests/golden/margins.toml`."""

from __future__ import annotations

import os

import pytest

from tests.golden import margins


@pytest.mark.slow
@pytest.mark.parametrize("example", margins.EXAMPLES)
def test_certified_margins_of_the_example_stay_where_they_were(example, tmp_path, request, monkeypatch):
    if example != "default_arm":
        monkeypatch.setitem(os.environ, "FLEXLINK_DATA", str(request.getfixturevalue("flexlink_data")))
    golden = margins.read()[example]
    measured = margins.measure(example, tmp_path / "run")
    assert measured.pop("certified") is golden["certified"]
    assert set(measured) == set(golden["tolerance"]), "golden file and measurement name different numbers"
    off = {
        name: (value, golden[name])
        for name, value in measured.items()
        if abs(value - golden[name]) > golden["tolerance"][name] * abs(golden[name])
    }
    assert not off, f"measured against golden: {off}; if meant, rerun python -m tests.golden.margins"
