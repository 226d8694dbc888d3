"""Numbers of an axis: where they stand, and their words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from workflow.figures.description import Axis

Real = npt.NDArray[np.float64]

# Steps between numbers that are read easily, times a power of ten: as of matplotlib.
_STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
# The same of numbers that are whole: 2.5 is none.
_WHOLE_STEPS = (1.0, 2.0, 5.0, 10.0)
# Steps of the decibel axis: 3 or 5 dB would not meet the 20 dB of a decade.
DECIBEL_STEPS = (1.0, 2.0, 4.0, 10.0)
# Numbers of a decibel axis at most, about: it stands beside another one, which has its own.
MOST_DECIBELS = 6
# Below a factor of 60 from end to end 1, 2, 5, 10 read better than powers of ten, of which there would be
# one.
_FEW = 60.0
# Below a factor of 5 even 1, 2, 5 gives fewer than three numbers: numbers stand evenly in the value then.
_EVEN = 5.0
# One number alone tells no scale.
_FEWEST = 2
# Larger or smaller numbers than 10 to this power are written with their power of ten beside the axis.
_POWER = 4
# Digits of powers of ten.
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, eq=False)
class Ticks:
    """Places (N,) and words of the numbers in view, places of the marks between them, and the power of ten
    that all numbers lack ("" as a rule)."""

    places: Real
    words: list[str]
    minor: Real
    power: str = ""


def ticks_of(axis: Axis, most: int) -> Ticks:
    """The numbers of an axis, at most about so many steps of them."""
    low, high = sorted(axis.limits())
    none = np.zeros(0)
    if axis.named is not None:
        named = [(place, words) for place, words in axis.named if low <= place <= high]
        return Ticks(np.array([place for place, _ in named]), [words for _, words in named], none)
    if axis.every is not None:
        places = _multiples(low, high, axis.every)
        if places.size > most + 1:
            places = _multiples(low, high, axis.every * -(-(places.size - 1) // most))
        return Ticks(places, [number(value) for value in places], none)
    if axis.kind == "log":
        return log_ticks(low, high, most)
    if axis.kind != "lin":
        return _linear_and_log(low, high, float(axis.kind))
    if axis.whole:
        step = max(1.0, _step(low, high, most, _WHOLE_STEPS))
        places = _multiples(low, high, step)
        return Ticks(places, [number(value) for value in places], none)
    return linear_ticks(low, high, most)


def linear_ticks(low: float, high: float, most: int, steps: tuple[float, ...] = _STEPS) -> Ticks:
    """Numbers at even steps."""
    step = _step(low, high, most, steps)
    places = _multiples(low, high, step)
    while places.size < _FEWEST and high > low:
        most += 1
        step = _step(low, high, most, steps)
        places = _multiples(low, high, step)
    largest = float(np.max(np.abs(places), initial=0.0))
    exponent = int(np.floor(np.log10(largest) + 1e-9)) if largest > 0 else 0
    if -_POWER < exponent < _POWER:
        exponent = 0
    return Ticks(places, _as_decimals(places / 10.0**exponent, step / 10.0**exponent), np.zeros(0), (
        f"×10{str(exponent).translate(_SUPERSCRIPT)}" if exponent else ""
    ))  # fmt: skip


def log_ticks(low: float, high: float, most: int) -> Ticks:
    """Powers of ten with marks between them; 1, 2, 5 or even steps over a short range."""
    first = int(np.floor(np.log10(low)))
    last = int(np.ceil(np.log10(high)))
    decades = np.asarray(10.0 ** np.arange(first, last + 1), dtype=np.float64)
    nine = (decades[:, None] * np.arange(1, 10)).ravel()
    if high / low < _FEW:
        if high / low < _EVEN:
            places = _multiples(low, high, _step(low, high, min(most, 5), _STEPS))
        else:
            places = _inside((decades[:, None] * np.array([1.0, 2.0, 5.0])).ravel(), low, high)
        minor = _inside(nine, low, high)
        minor = minor[~np.isclose(minor[:, None], places).any(axis=1)]
        return Ticks(places, [f"{value:g}" for value in places], minor)
    stride = max(1, -(-(last - first) // max(most, 1)))
    places = _inside(decades[-first % stride :: stride], low, high)
    minor = np.setdiff1d(_inside(decades if stride > 1 else nine, low, high), places)
    return Ticks(places, [power_of_ten(value) for value in places], minor)


def number(value: float) -> str:
    """A number with a true minus sign."""
    return f"{value:g}".replace("-", "\u2212")


def power_of_ten(value: float) -> str:
    """A power of ten: as a number from a thousandth to a thousand."""
    if not value > 0:
        return ""
    if 0.999e-3 <= value <= 1.001e3:
        return f"{value:g}"
    return f"10{str(round(np.log10(value))).translate(_SUPERSCRIPT)}"


def _step(low: float, high: float, most: int, steps: tuple[float, ...]) -> float:
    """The smallest easily read step of which no more than `most` go into the range."""
    least = (high - low) / max(most, 1) or 1.0
    ten = 10.0 ** np.floor(np.log10(least))
    return float(next(step * ten for step in (*steps, 10.0 * steps[0]) if step * ten >= least * (1 - 1e-9)))


def _multiples(low: float, high: float, step: float) -> Real:
    """Multiples of a step within a range, as exact as the step is."""
    counts = np.arange(np.ceil(low / step - 1e-6), np.floor(high / step + 1e-6) + 1)
    return np.asarray(counts * step + 0.0)


def _inside(places: Real, low: float, high: float) -> Real:
    is_inside = (places >= low * (1 - 1e-9)) & (places <= high * (1 + 1e-9))
    return places[is_inside]


def _as_decimals(values: Real, step: float) -> list[str]:
    """Numbers with as many decimals as their step needs, all of them alike."""
    digits = next((k for k in range(12) if abs(round(step, k) / step - 1) < 1e-6), 12)
    return [f"{value + 0.0:.{digits}f}".replace("-", "\u2212") for value in np.round(values, digits) + 0.0]


def _linear_and_log(low: float, high: float, linear: float) -> Ticks:
    """Numbers of a scale that is linear up to a size: zero, and powers of ten times that size."""
    reach = max(abs(low), abs(high), linear)
    powers = linear * 10.0 ** np.arange(0, int(np.ceil(np.log10(reach / linear))) + 1)
    places = np.concatenate([-powers[::-1], [0.0], powers])
    is_inside = (places >= low) & (places <= high)
    places = places[is_inside]
    return Ticks(places, [number(value) for value in places], np.zeros(0))
