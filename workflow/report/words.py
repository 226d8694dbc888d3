"""Numbers as words: the few phrases the report's sentences are made of."""

from __future__ import annotations

import math
from collections.abc import Sequence


def number(value: float | None, digits: int = 3) -> str:
    """Significant digits without a pointless exponent; 'none' and infinities in words."""
    if value is None:
        return "–"
    if math.isnan(value):
        return "not known"
    if math.isinf(value):
        return "unlimited" if value > 0 else "-unlimited"
    text = f"{value:.{digits}g}"
    if "e" in text and 1e-3 <= abs(value) < 1e6:
        text = f"{value:.0f}"
    return text


def quantity(value: float, unit: str) -> str:
    """A number with its unit, if anybody stated one."""
    return f"{number(value)} {unit}".rstrip()


def percent(value: float, digits: int = 3) -> str:
    return f"{number(value, digits)} %"


def frequency(omega_rad_s: float) -> str:
    """rad/s with Hz beside it."""
    return f"{number(omega_rad_s)} rad/s ({number(omega_rad_s / (2 * math.pi))} Hz)"


def listing(items: Sequence[str]) -> str:
    """a, b and c."""
    if not items:
        return ""
    return items[0] if len(items) == 1 else ", ".join(items[:-1]) + " and " + items[-1]


def count(n: int, one: str, many: str | None = None) -> str:
    """1 record, 3 records, no records."""
    words = one if n == 1 else (many or one + "s")
    return f"{'no' if n == 0 else n} {words}"


def decibels(factor: float) -> str:
    """A gain factor with its dB."""
    if math.isinf(factor):
        return "unlimited"
    return f"{number(factor)} ({20 * math.log10(factor):+.1f} dB)" if factor > 0 else "no lower limit"


def sentence(text: str) -> str:
    """With a capital at the start and a full stop at the end."""
    text = text.strip()
    if not text:
        return text
    first = text.split(maxsplit=1)[0]
    # "hub: ..." and "n_real = 1 ..." start with a name, and names keep their spelling.
    start = text if first.endswith(":") or "_" in first else text[0].upper() + text[1:]
    return start + ("" if text[-1] in ".!?" else ".")
