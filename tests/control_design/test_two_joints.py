"""The whole way of several joints: logs, model, ball, controller, certificate, the true arm, C code."""

import re

import pytest

from examples import two_joints


@pytest.mark.long
def test_logs_of_two_joints_become_a_certified_controller(tmp_path, capsys):
    two_joints.run(tmp_path)
    said = capsys.readouterr().out
    assert "certified: True" in said
    assert float(re.search(r"worst case ([\d.]+)", said)[1]) < 1
    assert float(re.search(r"largest pole ([\d.]+)", said)[1]) < 1
    # 2 free joints, 2 friction poles, 5 pairs: n + integrators, not twice as many.
    assert 12 <= int(re.search(r"model: (\d+) states", said)[1]) <= 15
    assert (tmp_path / "two_joints.c").read_text().count("limit") > 1
