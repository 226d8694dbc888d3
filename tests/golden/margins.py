"""Certified margins of the example runs: measured, compared with `margins.toml`, rewritten on request.

    FLEXLINK_DATA=/path/to/data python -m tests.golden.margins        # rewrites tests/golden/margins.toml

Run it only when a change is meant to move the margins, and say why in the commit and in CHANGELOG.md.
"""

import math
import os
import tempfile
import tomllib
from pathlib import Path
from typing import Any

from workflow.config.run_config import load_config
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.pipeline import config_of, run_pipeline
from workflow.tasks.results import RunResults

ROOT = Path(__file__).resolve().parents[2]
GOLDEN = Path(__file__).with_name("margins.toml")
EXAMPLES = ("default_arm", "slfr_krauss_2009", "daisy_robot_arm")

HEADER = """\
# Certified margins of the examples, worst case over the 95 % ellipses (first plant of each run).
# Made by:  FLEXLINK_DATA=/path/to/data python -m tests.golden.margins
#
# `tolerance` is relative. On one machine a run repeats to the last digit. Between machines the libraries
# round differently, searches end elsewhere on a flat optimum, and margins that no requirement holds move with
# it: the tolerances are two to ten times what three other sets of starts were seen to do (0.05 % in gamma,
# 0.1 % in modulus, 0.1 % of dB, 0.4 % in phase, 0.5 % in delay, 0.4 % in damping).
"""


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
    verdict = certificate.plants[0]
    worst = verdict.worst_margins
    band = config.specification.mode_band_rad_s
    zetas = [m.zeta for m in verdict.closed_loop_modes if band and band[0] <= m.omega_rad_s <= band[1]]
    return {
        "certified": certificate.certified,
        "gamma": certificate.gamma,
        "modulus_margin": worst.modulus,
        "gain_margin_dB": 20 * math.log10(worst.gain_up),
        "phase_margin_deg": math.degrees(worst.phase_rad),
        "delay_margin_s": worst.delay_s,
        "least_mode_damping": min(zetas),
    }


def moved(example: str, found: dict[str, Any]) -> dict[str, Any]:
    """What is not where the golden file has it: found and golden value by name."""
    golden = read()[example]
    assert found.keys() == {"certified", *golden["tolerance"]}, "other numbers than in the golden file"
    tolerances = {**golden["tolerance"], "certified": 0.0}
    return {
        name: (value, golden[name])
        for name, value in found.items()
        if abs(value - golden[name]) > tolerances[name] * abs(golden[name])
    }


def read() -> dict[str, dict[str, Any]]:
    """What the golden file holds."""
    return tomllib.loads(GOLDEN.read_text(encoding="utf-8"))


def write(measured: dict[str, dict[str, Any]], tolerances: dict[str, dict[str, float]]) -> None:
    """The golden file anew, tolerances kept."""
    lines = [HEADER]
    for example, numbers in measured.items():
        lines.append(f"[{example}]")
        for name, value in numbers.items():
            lines.append(f"{name} = {str(value).lower() if isinstance(value, bool) else f'{value:.6g}'}")
        lines.append(f"[{example}.tolerance]")
        lines += [f"{name} = {value}" for name, value in tolerances[example].items()]
        lines.append("")
    GOLDEN.write_text("\n".join(lines), encoding="utf-8")


def main() -> None:
    """Measure all examples and rewrite the golden file."""
    if "FLEXLINK_DATA" not in os.environ:
        raise SystemExit("set FLEXLINK_DATA to the folder of measured arms: two of the examples need it")
    tolerances = {example: entry["tolerance"] for example, entry in read().items()}
    with tempfile.TemporaryDirectory() as folder:
        measured = {example: measure(example, Path(folder) / example) for example in EXAMPLES}
    write(measured, tolerances)


if __name__ == "__main__":
    main()
