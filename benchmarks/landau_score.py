"""Score of Landau's flexible transmission (European Journal of Control, 1995): three loads, eight items, 0 to
100.

Control law R u = T r - S y with polynomials in q^-1, Ts = 0.05 s, 5 s records, step reference. Every item
counts for the worst load; the score is their mean, and 0 if any load is unstable.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

TS_S = 0.05
SAMPLES = 100
LOADS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "none": ((1, -1.41833, 1.58939, -1.31608, 0.88642), (0, 0, 0, 0.28261, 0.50666)),
    "half": ((1, -1.99185, 2.20265, -1.84083, 0.89413), (0, 0, 0, 0.10276, 0.18123)),
    "full": ((1, -2.09679, 2.31962, -1.93353, 0.87129), (0, 0, 0, 0.06408, 0.10407)),
}


@dataclass(frozen=True)
class Item:
    """Limit for the full score in words; share of the score (0 to 1 where it is between), and how far inside
    the limit, as a share of the limit (negative: outside), of a value."""

    limit: str
    share: Callable[[float], float]
    margin: Callable[[float], float]


ITEMS = {
    "rise_s": Item("<= 1", lambda v: 2 - v, lambda v: 1 - v),
    "peak": Item("<= 1.1", lambda v: (1.2 - v) / 0.1, lambda v: (1.1 - v) / 0.1),
    "rejection_s": Item("<= 1.2", lambda v: (1.4 - v) / 0.2, lambda v: (1.2 - v) / 1.2),
    "integrator": Item("yes", lambda v: v, lambda v: np.inf if v else -1.0),
    "attenuation_Hz": Item(">= 0.2", lambda v: (v - 0.1) / 0.1, lambda v: (v - 0.2) / 0.2),
    "sensitivity_dB": Item("<= 6", lambda v: (12 - v) / 6, lambda v: (6 - v) / 6),
    "delay_margin_s": Item(
        ">= 0.04", lambda v: (v / TS_S - 0.4) / 0.4, lambda v: (v - 0.8 * TS_S) / (0.8 * TS_S)
    ),
    "effort_dB": Item("<= 10", lambda v: (20 - v) / 10, lambda v: (10 - v) / 10),
}
_HZ = np.arange(1, 1001) * 0.01
# Frequencies for the crossovers, rad/sample.
_FINE = np.geomspace(1e-3, np.pi, 2000)


@dataclass(frozen=True, eq=False)
class Law:
    """R u = T r - S y; ascending powers of q^-1."""

    R: np.ndarray
    S: np.ndarray
    T: np.ndarray


def values(law: Law, load: tuple[tuple[float, ...], tuple[float, ...]]) -> dict[str, float] | None:
    """The raw value of each item for one load (A, B), or None if the loop is unstable."""
    a, b = (np.asarray(p, dtype=float) for p in load)
    ar = np.convolve(a, law.R)
    bs = np.convolve(b, law.S)
    size = max(ar.size, bs.size)
    closed = np.pad(ar, (0, size - ar.size)) + np.pad(bs, (0, size - bs.size))
    if not np.max(np.abs(np.roots(closed)), initial=0.0) < 1:
        return None
    t = TS_S * np.arange(SAMPLES)
    step = np.ones(SAMPLES)
    y = lfilter(np.convolve(b, law.T), closed, step)
    d = np.abs(lfilter(law.R, closed, step))
    last_off = np.flatnonzero(np.abs(y - 1) > 0.1)
    last_d = np.flatnonzero(d > 0.1 * np.max(d))
    z = np.exp(-2j * np.pi * _HZ * TS_S)
    sensitivity = np.polyval(ar[::-1], z) / np.polyval(closed[::-1], z)
    size_s = np.abs(sensitivity)
    with np.errstate(divide="ignore", invalid="ignore"):
        effort = np.abs(np.polyval(np.convolve(law.S, a)[::-1], z) / np.polyval(closed[::-1], z))
        effort_db = float(20 * np.log10(np.max(effort[_HZ >= 8 - 1e-9])))
    above = np.flatnonzero((size_s > 1 + 1e-12) & (_HZ > 0.2 + 1e-9))
    # |S| > 1 at 0.2 Hz or below it counts from where it begins.
    early = np.flatnonzero(size_s > 1 + 1e-12)
    first = early[0] if early.size and _HZ[early[0]] <= 0.2 else (above[0] if above.size else -1)
    return {
        "rise_s": (t[last_off[-1]] if last_off.size else 0.0) - 0.15,
        "peak": float(np.max(y)),
        "rejection_s": float(t[last_d[-1]]) if last_d.size else 0.0,
        "integrator": float(abs(np.sum(law.R)) < 1e-9 * np.sum(np.abs(law.R))),
        "attenuation_Hz": float(_HZ[first]) if first >= 0 else 10.0,
        "sensitivity_dB": float(20 * np.log10(np.max(size_s))),
        "delay_margin_s": TS_S * _delay_margin(ar, bs),
        "effort_dB": effort_db,
    }


def _delay_margin(ar: np.ndarray, bs: np.ndarray) -> float:
    """Smallest extra delay in samples that puts L = BS/(AR) on -1; inf without crossover."""

    def loop(w: np.ndarray) -> np.ndarray:
        z = np.exp(-1j * w)
        return np.polyval(bs[::-1], z) / np.polyval(ar[::-1], z)

    size = np.abs(loop(_FINE)) - 1.0
    cross = np.flatnonzero(size[1:] * size[:-1] <= 0)
    if not cross.size:
        return float("inf")
    low = _FINE[cross]
    high = _FINE[cross + 1]
    rising = size[cross] < 0
    for _ in range(40):
        mid = 0.5 * (low + high)
        below = (np.abs(loop(mid)) < 1.0) == rising
        low = np.where(below, mid, low)
        high = np.where(below, high, mid)
    phase = np.mod(np.angle(loop(mid)) + np.pi, 2 * np.pi)
    return float(np.min(phase / mid))


def points(item: str, value: float) -> float:
    """0 to 100 for one item and load."""
    return 100.0 * float(np.clip(ITEMS[item].share(value), 0, 1))


def all_values(law: Law) -> dict[str, dict[str, float]] | None:
    """Values of every load, or None if one is unstable."""
    by_load = {name: values(law, load) for name, load in LOADS.items()}
    if any(value is None for value in by_load.values()):
        return None
    return {name: value for name, value in by_load.items() if value is not None}


def score(law: Law) -> float:
    """0 to 100."""
    by_load = all_values(law)
    if by_load is None:
        return 0.0
    return float(np.mean([min(points(item, v[item]) for v in by_load.values()) for item in ITEMS]))


def margins(law: Law) -> dict[str, float]:
    """Smallest margin of every item over the loads; -inf everywhere if a load is unstable."""
    by_load = all_values(law)
    if by_load is None:
        return dict.fromkeys(ITEMS, -np.inf)
    return {item: min(ITEMS[item].margin(v[item]) for v in by_load.values()) for item in ITEMS}
