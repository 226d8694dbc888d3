"""Times of tests: whose they are, and what is not compared."""

from benchmarks import durations

CELL = '<properties><property name="cpu_s" value="{}"/></properties>'
CASE = f'<testcase classname="tests.{{}}" name="{{}}">{CELL}{{}}</testcase>'


def test_rooms_and_the_slowest(tmp_path):
    cases = [("ident.test_a", "test_one", 2.0, ""), ("ident.test_a", "test_two[x]", 7.5, "<failure/>")]
    cases += [("test_b", "test_three", 0.5, "<skipped/>"), ("test_b", durations.REFERENCE, 0.5, "")]
    path, lines = tmp_path / "a.xml", []
    rows = "".join(CASE.format(*case) for case in cases)
    path.write_text(f'<testsuites><testsuite hostname="here">{rows}</testsuite></testsuites>')
    durations.run(lambda line="": lines.append(line), junit=str(path), most=2)
    assert lines[0] == "2 passed, 1 failure, 1 skipped"
    rooms = "\n".join(" ".join(line.split()) for line in lines[2:5])
    assert rooms == "ident 2 10 90%\n(front door) 2 1 10%\nall 4 10 100%"
    assert "21 times" in lines[5]
    assert lines[-2].split()[1:] == ["failure", "tests/ident/test_a.py::test_two[x]"]
    assert lines[-1].split() == ["2.00", "passed", "tests/ident/test_a.py::test_one"]
