"""Scores of workshop answers against labelled cases, wherever they came from.

    python -m validation.blind.workshop.score LABELLED OUT

reads LABELLED/<case>/answer.toml and every diagnosis below OUT, the directory of `flexlink diagnose --out`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any

import typer

from validation.blind.report import text
from validation.blind.scores import scores
from validation.blind.worker import failed
from workflow.diagnose.document import FORMAT
from workflow.engine.errors import InputError

# Causes that are repaired at the same place.
_FAMILIES = {
    "friction": ("coulomb_friction", "stribeck_friction", "viscous_friction"),
    "actuator": (
        "actuator_saturation",
        "actuator_dead_zone",
        "actuator_gain",
        "actuator_lag",
        "input_delay",
    ),
    "torque": ("torque_ripple", "periodic_disturbance", "hardening_spring", "gravity"),
    "compliance": ("joint_compliance", "base_compliance", "backlash"),
    "link": ("link_stiffness", "structural_damping", "tip_payload", "hub_inertia"),
    "sensor": ("sensor_lag", "sensor_gain", "sensor_drift", "quantisation"),
}
# Family of each effect.
FAMILIES: Mapping[str, str] = MappingProxyType(
    {name: family for family, names in _FAMILIES.items() for name in names}
)


def score_folders(
    labelled: Path, found: Path, groups: Mapping[str, str] = FAMILIES, *, partial: bool = False
) -> dict[str, Any]:
    """Scores (`validation.blind.scores.scores`) of the diagnoses in a folder.

    A case without a diagnosis is wrong, or left out if partial. A nominal is exact if the rig file that was
    read has no tolerances.

    Parameters
    ----------
    labelled : Path
        Folder of labelled cases.
    found : Path
        Folder of diagnoses, as `flexlink diagnose --out` leaves them.
    groups : mapping of str to str
        Family of each effect.
    partial : bool

    Raises
    ------
    InputError
        There is no labelled case, or a diagnosis that belongs to none.
    """
    answers = {
        path.parent.name: {**tomllib.loads(path.read_text("utf-8")), "case": path.parent.name}
        for path in sorted(labelled.glob("*/answer.toml"))
    }
    if not answers:
        raise InputError(f"{labelled}: no labelled case is there; expected <case>/answer.toml")
    documents = {}
    timings = dict[str, Any]()
    for path in sorted(found.rglob("*.json")):
        document = json.loads(path.read_text("utf-8"))
        if path.name == "timings.json":  # of the same directory
            timings |= document
        if isinstance(document, dict) and document.get("format") == FORMAT:
            documents[str(document["case"])] = document
    strange = sorted(documents.keys() - answers.keys())
    if strange:
        raise InputError(f"{found}: {strange[0]} is none of the cases labelled in {labelled}")
    if not documents:
        raise InputError(f"{found}: no diagnosis is there; expected the --out of flexlink diagnose")
    names = [name for name in answers if name in documents or not partial]
    predictions = []
    for name in names:
        document = documents.get(name) or failed(name, "no diagnosis")
        predictions.append(document | timings.get(name, {}))
    for name, document in zip(names, predictions, strict=True):
        rig = labelled / name / document.get("rig_file", "rig.toml")
        if rig.is_file():
            stated = tomllib.loads(rig.read_text("utf-8"))
            answers[name]["nominal"] = "uncertain" if stated.get("tolerances") else "exact"
    return scores(predictions, [answers[name] for name in names], groups)


def main(
    labelled: Annotated[Path, typer.Argument(help="Directory of the labelled cases.")],
    found: Annotated[Path, typer.Argument(help="Directory of their diagnoses.")],
    partial: Annotated[bool, typer.Option("--partial", help="Leave out cases without a diagnosis.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="The scores as JSON.")] = False,
) -> None:
    try:
        scored = score_folders(labelled, found, partial=partial)
    except InputError as error:
        typer.echo(str(error), err=True)
        raise typer.Exit(2) from error
    typer.echo(json.dumps(scored, indent=1) if as_json else text(scored), nl=False)


if __name__ == "__main__":
    typer.run(main)
