"""Effects that can separate a machine from its nominal rig, and their registry.

A new effect is one registered class in the module of its group, and one entry in the contract test: its
parts are those of every effect (CONTRIBUTING.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from plant.effects import actuator, joint, link, sensor
from plant.effects.base import EFFECTS, LOOK_ALIKES, Effect
from plant.effects.search_space import EffectParameter
from plant.machine import Machine, VoltagePath
from plant.rig import Rig, one_line

__all__ = [
    "EFFECTS",
    "LOOK_ALIKES",
    "Effect",
    "EffectParameter",
    "actuator",
    "in_words",
    "joint",
    "link",
    "make_machine",
    "parse_effect",
    "parse_effects",
    "sensor",
]


def parse_effect(entry: Mapping[str, Any]) -> Effect:
    """An effect from a table, of the list or of what looks like one of it.

    Parameters
    ----------
    entry : mapping
        {"name": id, parameter: value, ...}.

    Returns
    -------
    Effect

    Raises
    ------
    ValueError
        One line naming the effect and the parameter, or listing the known effects.
    """
    if not isinstance(entry, Mapping):
        raise ValueError(f"an effect is a table with a name and its parameters; got {entry!r}")
    if "name" not in entry:
        raise ValueError(f"effect without a name; known effects: {', '.join(EFFECTS)}")
    name = entry["name"]
    kinds = {**EFFECTS, **LOOK_ALIKES}
    if not isinstance(name, str) or name not in kinds:
        raise ValueError(f"unknown effect {name!r}; known effects: {', '.join(kinds)}")
    try:
        values = {key: value for key, value in entry.items() if key != "name"}
        return kinds[name].model_validate(values)
    except ValidationError as error:
        raise ValueError(f"effect {name}: {one_line(error, kinds[name].model_fields)}") from error


def parse_effects(entries: Iterable[Mapping[str, Any]]) -> tuple[Effect, ...]:
    """Effects from tables, in their order; each as by `parse_effect`, with its errors."""
    return tuple(parse_effect(entry) for entry in entries)


def in_words(name: str) -> str:
    """Words for an effect's id, or for the answers "none" and "unknown", that fit into a sentence.

    An effect of one's own plant has its id without underscores, but for names of a model (elbow_cmd.delay).
    """
    kind = EFFECTS.get(name) or LOOK_ALIKES.get(name)
    if kind:
        return kind.words
    if name == "none":
        return "no effect at all"
    if name == "unknown":
        return "none of the candidate effects"
    if "." in name:
        return name
    return name.replace("_", " ")


def make_machine(rig: Rig, effects: Sequence[Effect] = ()) -> Machine:
    """The machine made of a rig and effects; the order of the effects does not matter.

    Raises ValueError if an entry is not an effect, or an effect is given twice.
    """
    # The stated delay is part of the nominal machine; an effect adds to it.
    machine = Machine(rig, VoltagePath(delay_s=rig.sampling.transport_delay_s))
    seen: set[str] = set()
    for effect in effects:
        if not isinstance(effect, Effect):
            raise ValueError(f"expected effects (see plant.effects); got {effect!r}")
        if effect.id in seen:
            raise ValueError(f"effect {effect.id} is given twice")
        seen.add(effect.id)
        machine = effect.modify(machine)
    return machine
