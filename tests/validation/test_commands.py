"""`flexlink blind` and `flexlink paper` are plugged in, and cost nothing before they are called."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("matplotlib", "scipy", "numpy", "validation.blind", "validation.paper")


def test_help_names_the_plugged_commands_without_importing_them():
    code = (
        "import sys; from workflow.cli import main; main(['--help']); "
        f"sys.exit(', '.join(set({HEAVY}) & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stderr.strip() == ""
    assert "\n  blind " in done.stdout
    assert "\n  paper " in done.stdout


def test_a_plugged_command_whose_argument_is_called_like_one_of_ours(tmp_path):
    command = [sys.executable, "-m", "workflow", "paper", "--out", "run"]
    (tmp_path / "run").write_text("a file")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("flexlink: cannot write run: ")
