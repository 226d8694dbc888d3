"""Numbers as words: the filters and functions that templates have, and the one place that formats a number.

Each takes plain values (None and non-finite ones too) and returns text; sentences stand in the templates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_DOWN, ROUND_FLOOR, Decimal
from typing import Any

import numpy as np
from markupsafe import Markup

from ident.data.foreign_files import as_typed

# In place of a number that is not there.
MISSING = "–"
# Heights of a sparkline, low to high.
BARS = "▁▂▃▄▅▆▇█"


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits without a pointless exponent; None is a dash, infinities and nan are words."""
    if value is None:
        return MISSING
    if math.isnan(value):
        return "not known"
    if math.isinf(value):
        return "unlimited" if value > 0 else "-unlimited"
    text = f"{value:.{digits}g}"
    # Between a thousandth and a million, people write numbers out.
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        text = f"{value:.0f}"
    return text


def at_least(value: float | None, digits: int = 3) -> str:
    """A lower bound (a margin): as `number`, rounded down."""
    return number(_rounded(value, digits, ROUND_FLOOR), digits)


def at_most(value: float | None, digits: int = 3) -> str:
    """An upper bound (a peak, an error): as `number`, rounded up."""
    return number(_rounded(value, digits, ROUND_CEILING), digits)


def bound(value: float | None, lower: bool, digits: int = 4) -> str:
    """`at_least` for a lower bound, else `at_most`."""
    return at_least(value, digits) if lower else at_most(value, digits)


def margin(value: float | None, digits: int = 3) -> str:
    """A margin of either sign: as `number`, rounded towards zero, so that what it says is there is there."""
    return number(_rounded(value, digits, ROUND_DOWN), digits)


def _rounded(value: float | None, digits: int, way: str) -> float | None:
    """To significant digits, towards one side."""
    if value is None or value == 0 or not math.isfinite(value):
        return value
    # Decimal digits as they are printed: a binary 0.3 is a little below and would round down to 0.299.
    exact = Decimal(repr(float(value)))
    return float(exact.quantize(Decimal(1).scaleb(exact.adjusted() - digits + 1), rounding=way))


def si(value: float | None, unit: str, digits: int = 3) -> str:
    """A number with its unit, if anybody stated one: 1.25 | si("N m") is "1.25 N m"."""
    text = number(value, digits)
    return text if text == MISSING or not unit else f"{text} {unit}"


def percent(value: float | None, digits: int = 3) -> str:
    """A value that is in percent already."""
    return si(value, "%", digits)


def share(value: float | None, digits: int = 4) -> str:
    """A share of one in percent: 0.95 | share is "95 %"."""
    return percent(None if value is None else 100 * value, digits)


def portion(value: float) -> str:
    """A share of a whole in full percent; estimates by subtraction that lie outside are none or all of it."""
    return percent(float(f"{100 * min(max(value, 0.0), 1.0):.0f}"))


def signed(value: float | None, unit: str = "", decimals: int = 2) -> str:
    """A number with its sign and a fixed number of decimals: "+0.50 %"."""
    return MISSING if value is None else f"{value:+.{decimals}f} {unit}".rstrip()


def fixed(value: float | None, decimals: int = 1) -> str:
    """A fixed number of decimals."""
    return MISSING if value is None else f"{value:.{decimals}f}"


def interval(ends: Sequence[float], digits: int | None = None) -> str:
    """low to high; without `digits`, as many as show two digits of what lies between."""
    low, high = ends
    if digits is not None:
        return f"{number(low, digits)} to {number(high, digits)}"
    if not (math.isfinite(low) and math.isfinite(high)):
        return "not known"
    # Decimals would be a row of zeros here, or none.
    if not 1e-7 < high - low < 1e5:
        return f"{low:.6g} to {high:.6g}"
    decimals = max(0, 1 - math.floor(math.log10(high - low)))
    return f"{low:.{decimals}f} to {high:.{decimals}f}"


def extent(values: Iterable[float], digits: int = 4) -> str:
    """Smallest to largest; one number where both read the same."""
    known = sorted(values)
    low, high = number(known[0], digits), number(known[-1], digits)
    return low if low == high else f"{low} to {high}"


def frequency(omega_rad_s: float | None, digits: int = 3) -> str:
    """rad/s with Hz beside it."""
    if omega_rad_s is None:
        return MISSING
    return f"{number(omega_rad_s, digits)} rad/s ({number(hertz(omega_rad_s), digits)} Hz)"


def both_frequencies(omega_rad_s: float | None) -> str:
    """rad/s with Hz in brackets, for a column whose head names these units."""
    if omega_rad_s is None:
        return MISSING
    return f"{number(omega_rad_s)} ({number(hertz(omega_rad_s))})"


def hertz(omega_rad_s: float) -> float:
    """rad/s as Hz."""
    return omega_rad_s / (2 * math.pi)


def decibels(factor: float, lower: bool = True) -> str:
    """A gain margin with its dB: inf sets no upper limit and 0 no lower one. lower: the gain may rise so far,
    rounded down; else it may fall to this, rounded up."""
    if math.isinf(factor):
        return "unlimited"
    if not factor > 0:
        return "no lower limit"
    in_db = Decimal(repr(in_decibels(factor))).quantize(
        Decimal("0.1"), rounding=ROUND_FLOOR if lower else ROUND_CEILING
    )
    return f"{bound(factor, lower, 3)} ({in_db:+} dB)"


def in_decibels(factor: float) -> float:
    """A gain factor (above 0) in dB."""
    return 20 * math.log10(factor)


def unit(text: str, name: str) -> str:
    """A unit behind numbers that are text already."""
    return f"{text} {name}".rstrip()


def listing(items: Iterable[object]) -> str:
    """a, b and c."""
    words = [str(item) for item in items]
    parts = [", ".join(words[:-1]), *words[-1:]]
    return " and ".join(part for part in parts if part)


def sparkline(values: Sequence[float], width: int = 60) -> str:
    """A signal as one line of bars: the mean of each part. Of a farthest sample a signal of two levels would
    show one of them only."""
    signal = np.asarray(values, dtype=np.float64)
    means = np.array([part.mean() for part in np.array_split(signal, min(width, signal.size))])
    span = float(np.ptp(means))
    if not span > 0:
        return ""
    highest_bar = len(BARS) - 1
    return "".join(BARS[round(highest_bar * (mean - means.min()) / span)] for mean in means)


def count(n: int, one: str, many: str | None = None) -> str:
    """1 record, 3 records, no records."""
    words = one if n == 1 else (many or one + "s")
    return f"{'no' if n == 0 else n} {words}"


def sentence(text: str) -> str:
    """A text on one line that begins with a capital and ends with a full stop; markup stays markup."""
    words = " ".join(text.split())
    if words:
        first = words.split(maxsplit=1)[0]
        # "hub: ...", "n_real ...", "elbow.damping ..." and "integrators = 1 ..." start with a name, and names
        # keep their case.
        named = first.endswith(":") or "_" in first or "." in first[:-1] or words.startswith(f"{first} = ")
        if not named:
            words = words[0].upper() + words[1:]
        if words[-1] not in ".!?":
            words += "."
    return Markup(words) if isinstance(text, Markup) else words


def capitalised(text: str) -> str:
    """A text whose first letter is a capital; the rest stays as it is."""
    return text[:1].upper() + text[1:]


def yes_no(state: bool | None) -> str:
    """A requirement's state in a table."""
    if state is None:
        return MISSING
    return "yes" if state else "NO"


def setting(value: Any) -> str:
    """The value of an option, as a person would write it down."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float | int):
        return number(float(value), 6)
    if isinstance(value, Mapping):
        return ", ".join(f"{key} = {part}" for key, part in value.items() if key != "name")
    if isinstance(value, tuple | list):
        return " to ".join(setting(part) for part in value)
    return str(value)


TESTS: Mapping[str, Callable[..., bool]] = {
    "finite": lambda value: value is not None and math.isfinite(value),
    "nan": math.isnan,
}
_NAMED: tuple[Callable[..., Any], ...] = (
    number, at_least, at_most, margin, bound, si, percent, share, portion, signed, fixed, interval, extent,
    frequency, hertz, decibels, in_decibels, unit, listing, sparkline, count, sentence, capitalised, yes_no,
    setting,
)  # fmt: skip
FILTERS: Mapping[str, Callable[..., Any]] = {
    "quoted": as_typed,
    **{function.__name__: function for function in _NAMED},
    "fmt": format,
    "ln": math.log,
    "degrees": math.degrees,
}
