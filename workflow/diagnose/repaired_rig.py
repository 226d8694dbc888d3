"""The repaired machine as files: a rig file with the parameters re-estimated, and the effects beside it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import tomlkit

from plant.effects import Effect
from plant.rig import Rig


def rig_text(
    case: str, stated: Rig, repaired: Rig, deviations: Mapping[str, float], effects_file: str
) -> str:
    """A rig file that `Rig.from_toml` reads back as `repaired`.

    The head names every moved value with how far it moved; effects_file is empty where there are no effects.
    """
    head = [f"# {case}: rig as repaired by flexlink diagnose"]
    for key, d in deviations.items():
        old, new = stated.value(key), repaired.value(key)
        if old != new:
            percent = 100 * (new / old - 1) if old else 0.0
            head.append(f"#   {key}: {old:.6g} stated, {new:.6g} now ({percent:+.2f} %, {d:+.2f} tolerances)")
    if effects_file:
        head.append(f"# The effects to add stand in {effects_file}.")
    return "\n".join(head) + "\n" + repaired.to_toml()


def effects_text(case: str, effects: Sequence[Effect]) -> str:
    """The effects as [[effects]] tables, in the spelling of [[source.effects]] in a run configuration."""
    tables = tomlkit.dumps({"effects": [effect.to_dict() for effect in effects]})
    place = "in a run configuration they go under [[source.effects]]"
    return f"# {case}: effects found by flexlink diagnose; {place}\n\n{tables}"
