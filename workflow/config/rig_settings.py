"""How a configuration names the simulated machine: a preset or a rig file, and effects by their id."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, PlainValidator, ValidationInfo

from plant.effects import parse_effect
from plant.presets import paper_link
from plant.rig import Rig
from workflow.config.settings import resolve
from workflow.engine import documents
from workflow.engine.errors import naming, shortened

PRESETS: dict[str, Callable[[], Rig]] = {"paper_link": paper_link}


def read_rig(path: Path) -> Rig:
    """A rig file. Raises InputError naming it and the dotted key."""
    _, content = documents.read_toml(path)
    with naming(str(path)):
        return Rig.from_document(content, str(path))


def _choose_rig(value: Any, info: ValidationInfo) -> str | Path:
    """A preset's name, or a rig file that is there and can be read."""
    if not isinstance(value, (str, Path)):
        raise ValueError(
            f"expected the name of a preset ({', '.join(PRESETS)}) or the path of a rig file, got "
            f"{shortened(value)}"
        )
    text = str(value)
    if text in PRESETS:
        return text
    path = resolve(Path(text), info, kind=f"rig file (presets: {', '.join(PRESETS)})")
    if not (info.context or {}).get("may_be_gone"):
        read_rig(path)
    return path


RigChoice = Annotated[str | Path, PlainValidator(_choose_rig), PlainSerializer(str, return_type=str)]
EffectTable = Annotated[dict[str, Any], BeforeValidator(lambda value: parse_effect(value).to_dict())]
