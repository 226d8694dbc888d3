"""Scores of a finished diagnosis against answers that lie open beside the cases.

    python -m validation.blind.score DIAGNOSIS CASES [--json]

DIAGNOSIS is the directory of `flexlink diagnose --out`, CASES a folder of case folders with answer.toml.
Cases without a diagnosis are left out and named.
"""

from __future__ import annotations

import argparse
import json
import sys
import tomllib
from pathlib import Path
from typing import Any

from validation.blind.report import scores_text
from validation.blind.scores import scores
from workflow.engine.errors import InputError, one_line
from workflow.engine.storage import read_json, strict_json

_TIMINGS = "timings.json"


def answers_of(predictions: dict[str, dict[str, Any]], cases: Path) -> list[dict[str, Any]]:
    """Answer of every predicted case; its nominal is exact if the rig file that was read has no tolerances.

    Raises InputError naming the file that is missing or no TOML.
    """
    found = []
    for name, prediction in predictions.items():
        answer = _toml(cases / name / "answer.toml")
        rig = _toml(cases / name / str(prediction.get("rig_file", "rig.toml")))
        found.append({**answer, "case": name, "nominal": "uncertain" if rig.get("tolerances") else "exact"})
    return found


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise InputError(f"{path}: not valid TOML: {error}") from error


def score(diagnosis: Path, cases: Path) -> tuple[dict[str, Any], list[str]]:
    """Scores, and the cases that have no diagnosis. Raises InputError, one line."""
    if not cases.is_dir():
        raise InputError(f"{cases}: no such directory")
    folders = sorted(p.name for p in cases.iterdir() if (p / "answer.toml").is_file())
    timings = read_json(diagnosis / _TIMINGS) if (diagnosis / _TIMINGS).is_file() else {}
    predictions = {
        name: {**read_json(diagnosis / f"{name}.json"), **timings.get(name, {})}
        for name in folders
        if (diagnosis / f"{name}.json").is_file()
    }
    if not predictions:
        raise InputError(f"{diagnosis} answers none of the cases in {cases}")
    found = scores(list(predictions.values()), answers_of(predictions, cases))
    return found, [name for name in folders if name not in predictions]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("diagnosis", type=Path)
    parser.add_argument("cases", type=Path)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    try:
        found, missing = score(given.diagnosis, given.cases)
    except InputError as error:
        parser.exit(2, f"{one_line(error)}\n")
    if given.json:
        sys.stdout.write(json.dumps(strict_json(found), indent=1, allow_nan=False) + "\n")
        return
    sys.stdout.write(scores_text(found))
    if missing:
        sys.stdout.write(f"\nwithout a diagnosis: {', '.join(missing)}\n")


if __name__ == "__main__":
    main()
