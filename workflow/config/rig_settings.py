"""How a configuration names the simulated machine: a preset or a rig file, and effects by their id."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, PlainSerializer, PlainValidator, ValidationInfo

from plant import Rig, parse_effect
from plant.presets import paper_link
from workflow.config.settings import resolve

PRESETS: dict[str, Callable[[], Rig]] = {"paper_link": paper_link}


def _choose_rig(value: Any, info: ValidationInfo) -> str | Path:
    """A preset's name, or a rig file that is there and can be read."""
    if not isinstance(value, (str, Path)):
        raise ValueError(
            f"expected the name of a preset ({', '.join(PRESETS)}) or the path of a rig file, got {value!r}"
        )
    text = str(value)
    if text in PRESETS:
        return text
    path = resolve(Path(text), info, kind=f"rig file (presets: {', '.join(PRESETS)})")
    if not (info.context or {}).get("may_be_gone"):
        Rig.from_toml(path)
    return path


RigChoice = Annotated[str | Path, PlainValidator(_choose_rig), PlainSerializer(str, return_type=str)]
EffectTable = Annotated[dict[str, Any], BeforeValidator(lambda value: parse_effect(value).to_dict())]
