"""Effects, parameters and shares in words a person can read aloud."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence

from plant.effects import EFFECTS, LOOK_ALIKES
from workflow.report.formats import number

_OTHERS: Mapping[str, str] = {"none": "no effect at all", "unknown": "a cause outside the list"}

GROUPS: Mapping[str, str] = {
    "actuator": "actuator",
    "joint": "joint and hub",
    "link": "link",
    "sensor": "tip sensor",
    "environment": "from outside",
    "none": "nothing missing",
    "unknown": "outside the list",
}

# Longest ending first: "stiffness_Nm_rad" is no "rad".
_UNITS: Mapping[str, str] = {
    "_Nm_rad3": "N m/rad³",
    "_Nm_rad": "N m/rad",
    "_Nm_A": "N m/A",
    "_Vs_rad": "V s/rad",
    "_kg_m2": "kg m²",
    "_kg_m3": "kg/m³",
    "_rad_s": "rad/s",
    "_m_s2": "m/s²",
    "_m_s": "m/s",
    "_Nms": "N m s",
    "_Nm": "N m",
    "_kg": "kg",
    "_Pa": "Pa",
    "_Hz": "Hz",
    "_ohm": "ohm",
    "_rad": "rad",
    "_V": "V",
    "_s": "s",
    "_m": "m",
}


def effect_words(name: str) -> str:
    """An effect, "none" or "unknown" in words; a user's own effect by its id without underscores."""
    known = EFFECTS.get(name) or LOOK_ALIKES.get(name)
    return known.words if known else _OTHERS.get(name, name.replace("_", " "))


def unit_of(parameter: str) -> str:
    """Unit from the ending of a parameter's name; empty for pure numbers."""
    name = parameter.rpartition(".")[2]
    return next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "")


def parameter_name(parameter: str) -> str:
    """`stribeck_velocity_rad_s` as "stribeck velocity"."""
    name = parameter.rpartition(".")[2]
    ending = next((ending for ending in _UNITS if name.endswith(ending)), "")
    return name.removesuffix(ending).replace("_", " ")


def parameter_words(parameter: str, value: float, interval: Sequence[float] | None) -> str:
    """Name, value, unit and 95 % interval."""
    text = f"{parameter_name(parameter)} {number(value, 4)} {unit_of(parameter)}".rstrip()
    if interval is None:
        return text
    return f"{text} (95 %: {number(interval[0], 4)} to {number(interval[1], 4)})"


def key_words(key: str) -> str:
    """A dotted key of the rig file: "hub.inertia_kg_m2" as "inertia of the hub"."""
    section, _, name = key.partition(".")
    what = parameter_name(name)
    return what if re.search(rf"\b{section}\b", what) else f"{what} ({section})"


def probability_words(p: float) -> str:
    """A probability in percent, without claiming 100 or 0."""
    percent = 100 * p
    if percent > 99.9:
        return "over 99.9 %"
    if percent < 0.1:
        return "under 0.1 %"
    return f"{percent:.3g} %" if percent < 99 else f"{percent:.1f} %"


def times_noise(rms: float) -> str:
    """A residual over noise, fine enough to tell 1.003 from 1."""
    if math.isnan(rms):
        return "–"
    return f"{rms:.3f}" if rms < 10 else f"{rms:.1f}"


def sureness(p: float) -> str:
    """How sure that is, in a word."""
    for limit, word in (
        (0.99, "practically certain"),
        (0.9, "very likely"),
        (0.66, "likely"),
        (0.33, "possible"),
    ):
        if p >= limit:
            return word
    return "unlikely"
