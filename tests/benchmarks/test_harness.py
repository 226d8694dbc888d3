"""The harness: options from the signature, a results file from whole runs only."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import harness


@pytest.fixture(autouse=True)
def results(monkeypatch, tmp_path):
    monkeypatch.setattr(harness, "RESULTS", tmp_path)
    return tmp_path


def run(out, *, seeds: int = 3, cases: tuple[str, ...] = ("a", "b"), slow: bool = False) -> None:
    """Tells its options."""
    out(f"{seeds} {cases} {slow}")
    out()
    if slow:
        raise RuntimeError("half way")


def test_a_run_as_it_is_writes_command_seeds_commit_date_and_lines(results, monkeypatch, capsys):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    harness.main(run, [])
    head, *lines = (results / "test_harness.txt").read_text().splitlines()
    assert lines == ["3 ('a', 'b') False", ""]
    assert re.fullmatch(
        r"# OMP_NUM_THREADS=1 python -m benchmarks.test_harness   "
        r"\(seeds 0 to 2; commit \S+; \d{4}-\d\d-\d\d\)",
        head,
    )
    assert capsys.readouterr().out.splitlines() == [head, *lines]


@pytest.mark.parametrize(
    ("arguments", "line", "written"),
    [
        (["--seeds", "5"], "5 ('a', 'b') False", []),
        (["--cases", "/c", "--name", "other"], "3 ('/c',) False", ["other.txt"]),
        (["--seeds", "3"], "3 ('a', 'b') False", ["test_harness.txt"]),
    ],
)
def test_other_options_are_written_under_another_name_only(results, capsys, arguments, line, written):
    harness.main(run, arguments)
    head, *said = capsys.readouterr().out.splitlines()
    assert line in said
    assert " /" not in head
    assert [path.name for path in results.iterdir()] == written


def test_nothing_is_written_by_half_a_run(results):
    with pytest.raises(RuntimeError):
        harness.main(run, ["--slow", "--name", "half"])
    assert not list(results.iterdir())


def test_missing_data_ends_the_program_in_one_line(monkeypatch, tmp_path):
    monkeypatch.setenv("FLEXLINK_DATA", str(tmp_path))
    with pytest.raises(SystemExit, match="set FLEXLINK_DATA to the folder that holds emps"):
        harness.data_folder("emps")


MODULES = sorted(
    path.stem
    for path in Path(harness.__file__).parent.glob("*.py")
    if "main(run" in path.read_text(encoding="utf-8") and path.stem != "harness"
)


@pytest.mark.long
def test_every_benchmark_explains_its_options():
    assert len(MODULES) >= 20
    code = (
        "import importlib, sys\n"
        "from benchmarks import harness\n"
        f"for name in {MODULES}:\n"
        "    module = importlib.import_module(f'benchmarks.{name}')\n"
        "    try:\n"
        "        harness.main(module.run, ['--help'])\n"
        "    except SystemExit as end:\n"
        "        assert end.code == 0, name\n"
    )
    root = Path(harness.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("usage: ") == len(MODULES)
