"""Times of tests: whose they are, and what is not compared."""

from __future__ import annotations

from benchmarks import durations

NOTED = '<properties><property name="cpu_s" value="{}"/></properties>'
CASE = f'<testcase classname="{{}}" name="{{}}">{NOTED}{{}}</testcase>'


def junit(path, cases):
    rows = "".join(CASE.format(*case) for case in cases)
    path.write_text(f'<testsuites><testsuite hostname="here">{rows}</testsuite></testsuites>')
    return str(path)


CASES = [
    ("tests.ident.test_a", "test_one", 2.0, ""),
    ("tests.ident.test_a", "test_two[x]", 7.5, "<failure/>"),
    ("tests.test_b", "test_three", 0.5, "<skipped/>"),
    ("tests.test_b", durations.REFERENCE, 0.5, ""),
]


def test_rooms_and_the_slowest(tmp_path, capsys):
    lines = []
    durations.run(lambda line="": lines.append(line), junit=junit(tmp_path / "a.xml", CASES), most=2)
    assert lines[0] == "2 passed, 1 failure, 1 skipped"
    rooms = {line.split("  ")[0]: line.split()[-3:] for line in lines[2:5]}
    assert rooms == {
        "ident": ["2", "10", "90%"],
        "(front door)": ["2", "1", "10%"],
        "all": ["4", "10", "100%"],
    }
    assert "21 times" in lines[5]
    assert lines[-2:] == [
        "    7.50  failure  tests/ident/test_a.py::test_two[x]",
        "    2.00  passed   tests/ident/test_a.py::test_one",
    ]
