"""Effects, parameters, keys and probabilities of a diagnosis, as every sentence about them spells them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from plant.effects import in_words
from workflow.text.formats import MISSING, fixed, interval, listing, number, si
from workflow.text.names import name_words, stated_name, stated_unit, unit_of

# Least probability -> the word for it: the likelihood scale of the IPCC, coarser at its lower end.
_SURENESS = {
    0.99: "practically certain",
    0.9: "very likely",
    0.66: "likely",
    0.33: "possible",
    0.0: "unlikely",
}
# A threshold below the specified share by less than this is that share, but for rounding.
_SAME_THRESHOLD = 0.999
# Below so many times the noise three decimals tell 1.003 from 1; above, they are no use.
_FINE = 10.0


def parameter_words(parameter: str, value: float, bounds: Sequence[float] | None = None) -> str:
    """Name, value, unit and 95 % interval."""
    text = f"{stated_name(parameter)} {si(value, stated_unit(parameter), 4)}"
    return text if bounds is None else f"{text} (95 %: {interval(bounds, 4)})"


def value_words(parameter: str, value: float, digits: int = 3) -> str:
    """A value with the unit that the parameter's name states."""
    return si(value, stated_unit(parameter), digits)


def key_words(key: str) -> str:
    """A key of the rig file, "hub.inertia_kg_m2" as "inertia (hub)"; of one's own plant without a section."""
    section, _, name = key.rpartition(".")
    if not section:
        return stated_name(name)
    what = name_words(name)
    return what if re.search(rf"\b{section}\b", what) else f"{what} ({section})"


def setting_words(name: str, value: float | int | str) -> str:
    """up_to_Hz 35.0 as "up to 35 Hz"."""
    what, _, unit = name.rpartition("_")
    if not what or isinstance(value, str):
        return f"{name.replace('_', ' ')} {value}"
    return f"{what.replace('_', ' ')} {si(value, unit)}"


def output_unit(output: str, units: Mapping[str, str]) -> str:
    """Unit of an output: what its name states, else what `units` says of it."""
    return unit_of(output) or units.get(output, "")


def probability_words(p: float) -> str:
    """A probability in percent, without claiming 100 or 0."""
    percent = 100 * p
    # No list of candidates is complete, and no noise level exact: no answer is certain.
    if percent > 99.9:
        return "over 99.9 %"
    if percent < 0.1:
        return "under 0.1 %"
    return f"{number(percent) if percent < 99 else fixed(percent)} %"


def times_noise(rms: float) -> str:
    """A residual over noise, fine enough to tell 1.003 from 1."""
    return MISSING if math.isnan(rms) else fixed(rms, 3 if rms < _FINE else 1)


def sureness(p: float) -> str:
    """How sure that is, in a word."""
    return next(word for limit, word in _SURENESS.items() if p >= limit)


def names_words(effects: Iterable[str]) -> str:
    """Effects as "a, b and c"."""
    return listing([in_words(name) for name in effects])


def with_sizes(effects: Iterable[Any]) -> str:
    """Effects of a repaired model, each with its sizes: "dry friction (torque 0.04 N m) and ..."."""
    sizes = []
    for effect in effects:
        parameters = [parameter_words(key, value) for key, value in effect.parameters().items()]
        sizes.append(f"{in_words(effect.id)} ({' and '.join(parameters)})")
    return " and ".join(sizes)


def begun(text: str) -> str:
    """Text with the capital that begins a sentence, but for names of a model (arm.payload)."""
    return text if "." in text.split(" ")[0] else text[:1].upper() + text[1:]


def is_of_forces(threshold: float, model_error: float) -> bool:
    """Whether a threshold counts only what the forces make, and is below the specified share for that."""
    return 0 < threshold < _SAME_THRESHOLD * model_error
