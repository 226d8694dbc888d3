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


def test_a_plugged_command_whose_argument_is_called_like_one_of_ours(refused, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").write_text("a file")
    assert refused("paper", "--out", "run").startswith("flexlink: cannot write run: ")
