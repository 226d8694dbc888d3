"""Names of parameters and outputs with their units at the end, as rig files and own plants spell them."""

from __future__ import annotations

import re

# A unit at the end of a name, as the rig file spells it: units multiplied, then after "_" those divided by.
_FACTORS = r"(?:(?:rad|ohm|kg|Pa|Hz|N|m|s|V|A)[23]?)"
# The unit with the "_" before it; group 1: over the line, group 2: under it.
_UNIT = re.compile(rf"_({_FACTORS}+)(?:_({_FACTORS}+))?$")
# Digits behind a unit are its power.
_POWERS = str.maketrans("23", "²³")
# A letter with a letter behind "_" is a symbol with its index, k_s or J_m, as likely as a value with a unit.
_SYMBOL = re.compile(r"[^\W\d_]\d*_[^\W\d_]")


def unit_of(parameter: str) -> str:
    """Unit from the ending of a parameter's name, "N m/rad" for _Nm_rad; empty for pure numbers."""
    ending = _UNIT.search(parameter)
    if ending is None:
        return ""
    if parameter[: ending.start()].endswith("_per"):
        return f"1/{ending[1].translate(_POWERS)}"
    over, under = (" ".join(re.findall(_FACTORS, part or "")).translate(_POWERS) for part in ending.groups())
    if not under:
        return over
    # An inertia is the one product that is written with a "_" between.
    if (over, under) == ("kg", "m²"):
        return f"{over} {under}"
    return f"{over}/{under}"


def stated_unit(parameter: str) -> str:
    """Unit of a parameter whose name states one without doubt: none of a symbol with an index, as k_s."""
    return "" if _SYMBOL.fullmatch(parameter) else unit_of(parameter)


def stated_name(parameter: str) -> str:
    """Name of a parameter without the unit that it states: "torque_Nm" as "torque", but k_s as it is."""
    return parameter if _SYMBOL.fullmatch(parameter) else name_words(parameter)


def name_words(parameter: str) -> str:
    """Name without its unit: "torque_Nm" as "torque"."""
    return _UNIT.sub("", parameter).removesuffix("_per").replace("_", " ").replace("youngs", "Young's")
