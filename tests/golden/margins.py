"""Certified margins of the example runs: measured, compared with `margins.toml`, rewritten on request.

    FLEXLINK_DATA=/path/to/data python -m tests.golden.margins        # rewrites tests/golden/margins.toml

Run it only when a change is meant to move the margins, and say why in the commit and in CHANGELOG.md.
"""

import os
import tempfile
from pathlib import Path
from typing import Any

from workflow.commands.certify import against, worst_cases, write_baseline
from workflow.config.run_config import load_config
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.pipeline import config_of, run_pipeline
from workflow.tasks.results import RunResults

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = Path(__file__).with_name("margins.toml")
EXAMPLES = ("default_arm", "slfr_krauss_2009", "daisy_robot_arm")


def measure(example: str, out: Path) -> dict[str, Any]:
    """Run an example and read its certificate: plain numbers in the units of their names."""
    config, text = load_config(ROOT / "examples" / f"{example}.toml")
    run_pipeline(config, out, config_text=text)
    return of_run(out)


def of_run(out: Path) -> dict[str, Any]:
    """The same of a run that is there."""
    run = RunDirectory.open(out)
    config, certificate = config_of(run), RunResults(run).certify.certificate
    assert certificate is not None, f"{out}: no controller to certify"
    return worst_cases(certificate, config.specification)[certificate.plants[0].plant]


def moved(example: str, found: dict[str, Any]) -> dict[str, tuple[float, float, str]]:
    """What is not where the golden file has it: found and golden value by name."""
    return {name: held for name, held in against(found, GOLDEN, example).items() if held[2] != "as before"}


def main() -> None:
    """Measure all examples and rewrite the golden file, tolerances kept."""
    if "FLEXLINK_DATA" not in os.environ:
        raise SystemExit("set FLEXLINK_DATA to the folder of measured arms: two of the examples need it")
    with tempfile.TemporaryDirectory() as folder:
        measured = {example: measure(example, Path(folder) / example) for example in EXAMPLES}
    write_baseline(GOLDEN, measured)


if __name__ == "__main__":
    main()
