"""Where the pole search looks: boxes from the data, and maps from the unit cube to poles.

Coordinates "log": log10(1 - a) for a real pole, (log10 omega, log10 zeta) for a pair. Coordinates "raw":
the paper's own x, and (beta, gamma) of (29). Poles of equal type are ordered by the triangular map s2 = s1
+ (hi - s1) x2 on their first coordinate: two equal real poles are a saddle that DIRECT would sample and a
descent cannot leave.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable

from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import COMPILED, RealArray, kernel_array, lock

# A pair this close to critical damping is two real poles in disguise; its two columns become dependent.
ZETA_LIMIT = 0.98
# Links have more; an undamped pair with a free initial state fits any slow disturbance.
ZETA_LEAST = 1e-3


@dataclass(frozen=True, eq=False)
class SearchSpace:
    """Box of a search for n_real real poles and n_pairs pairs, as low and high (3,) of one pole of each type.

    low, high: [real, pair first, pair second] in the coordinates of the module text; frequencies in
    rad/sample.
    """

    n_real: int
    n_pairs: int
    low: RealArray
    high: RealArray
    raw: bool
    dt_s: float

    def __post_init__(self) -> None:
        lock(self, "low", "high")
        if not np.all(self.low < self.high):
            names = ("real pole", "pair frequency", "pair damping")
            i = int(np.flatnonzero(~(self.low < self.high))[0])
            raise ValueError(
                f"the search box of the {names[i]} is empty: its lower bound is not below its upper bound"
            )

    @property
    def dimension(self) -> int:
        return self.n_real + 2 * self.n_pairs

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coordinate, with its unit."""
        real = "x" if self.raw else "log10(1 - a)"
        pair = ("beta", "gamma") if self.raw else ("log10(omega [rad/s])", "log10(zeta)")
        pairs = [f"{name} {i + 1}" for i in range(self.n_pairs) for name in pair]
        return (*(f"{real} {i + 1}" for i in range(self.n_real)), *pairs)

    def _at(self, units: RealArray) -> RealArray:
        """Coordinates of one point (D,), or of as many as there are columns (D, E)."""
        return np.asarray(_coordinates_of_point(units, self.n_real, self.low, self.high))

    def blocks(self, unit: RealArray) -> RealArray:
        """Cascade blocks (R + P, 4) of a point of the unit cube."""
        return np.asarray(
            blocks_of_point(kernel_array(unit), self.n_real, self.low.copy(), self.high.copy(), self.raw)
        )

    def poles(self, unit: RealArray) -> Poles:
        """Poles of a point of the unit cube; a pair of the raw box that is not complex is put at zeta =
        0.95."""
        if not self.raw:
            point = self._at(unit)
            real, first, second = point[: self.n_real], point[self.n_real :: 2], point[self.n_real + 1 :: 2]
            omega, zeta = 10.0**first, 10.0**second
            return Poles(1 - 10.0**real, np.exp(omega * (-zeta + 1j * np.sqrt(1 - zeta**2))))
        blocks = self.blocks(unit)
        gamma, beta = blocks[self.n_real :, 0], blocks[self.n_real :, 1]
        re = beta * (1 + gamma) / 2
        im = np.sqrt(np.maximum(gamma - re**2, 0.0))
        pairs = re + 1j * im
        with np.errstate(divide="ignore"):
            log = np.log(np.where(pairs == 0, 1e-3, pairs))
        size = np.minimum(np.abs(log), 0.9 * np.pi)
        zeta = np.clip(-log.real / size, 1e-6, 0.95)
        proper = (im > 0) & (-log.real < 0.95 * np.abs(log))
        pairs = np.where(proper, pairs, np.exp(size * (-zeta + 1j * np.sqrt(1 - zeta**2))))
        return Poles(blocks[: self.n_real, 0], pairs)

    def levels(self, poles: Poles) -> RealArray:
        """Where poles lie in the box, 0 to 1: (R + P,) by their first coordinate, those beyond on its
        side."""
        if self.raw:
            first = np.concatenate([poles.real, 2 * poles.pairs.real / (1 + np.abs(poles.pairs) ** 2)])
        else:
            first = np.log10(np.concatenate([1 - poles.real, np.abs(np.log(poles.pairs))]))
        low = np.repeat(self.low[:2], poles.counts)
        return np.asarray(np.clip((first - low) / (np.repeat(self.high[:2], poles.counts) - low), 0, 1))

    def coordinates(self, units: RealArray) -> RealArray:
        """Coordinates (E, D) of points (E, D) of the unit cube; frequencies in rad/s."""
        points = self._at(units.T).T
        if not self.raw:
            points[:, self.n_real :: 2] -= np.log10(self.dt_s)
        return points


def search_space(n_real: int, n_pairs: int, longest: int, dt_s: float, options: IdentOptions) -> SearchSpace:
    """Box from record length (samples) and sampling time; bounds given in the options replace its sides.

    1 - a in [0.2/N, 0.7], omega in [4 pi/(N dt), 0.9 pi/dt], zeta in [1e-3, 0.63].
    """
    n = max(longest, 30)
    if options.coordinates == "raw":
        edge = 1 - 0.2 / n
        return SearchSpace(
            n_real, n_pairs, np.array([0.0, -edge, 0.0]), np.array([edge, edge, edge]), True, dt_s
        )
    low = [np.log10(0.2 / n), np.log10(4 * np.pi / n), np.log10(ZETA_LEAST)]
    high = [np.log10(0.7), np.log10(0.9 * np.pi), np.log10(0.63)]
    for side, end in ((low, "min"), (high, "max")):
        decay, omega = getattr(options, f"decay_{end}_per_s"), getattr(options, f"omega_{end}_rad_s")
        stated = (
            None if decay is None else -np.expm1(-decay * dt_s),
            None if omega is None else min(omega * dt_s, 0.99 * np.pi),
            getattr(options, f"zeta_{end}"),
        )
        side[:] = [was if to is None else np.log10(to) for was, to in zip(side, stated, strict=True)]
    return SearchSpace(n_real, n_pairs, np.array(low), np.array(high), False, dt_s)


@register_jitable(inline="always")
def _coordinates_of_point(unit: Any, n_real: int, low: Any, high: Any) -> Any:
    point = np.empty_like(unit)
    floor = low[0]
    for i in range(n_real):
        floor = floor + (high[0] - floor) * unit[i]
        point[i] = floor
    floor = low[1]
    for i in range(n_real, unit.shape[0], 2):
        floor = floor + (high[1] - floor) * unit[i]
        point[i] = floor
        point[i + 1] = low[2] + (high[2] - low[2]) * unit[i + 1]
    return point


@numba.njit(**COMPILED)
def blocks_of_point(unit: Any, n_real: int, low: Any, high: Any, raw: bool) -> Any:
    """Cascade blocks (`ident.basis.functions.block_parameters`) of a point of the unit cube."""
    point = _coordinates_of_point(unit, n_real, low, high)
    blocks = np.zeros((n_real + (unit.size - n_real) // 2, 4))
    for i in range(n_real):
        distance = 1.0 - point[i] if raw else 10.0 ** point[i]
        blocks[i, 0] = 1.0 - distance
        blocks[i, 1] = math.sqrt(distance * (2.0 - distance))
    for i in range(n_real, blocks.shape[0]):
        first, second = point[2 * i - n_real], point[2 * i - n_real + 1]
        if raw:
            beta, gamma = first, second
            sb = math.sqrt((1 - beta) * (1 + beta))
            one_minus_gamma = 1 - gamma
        else:
            omega, zeta = 10.0**first, 10.0**second
            decay, angle = zeta * omega, omega * math.sqrt(1 - zeta * zeta)
            gamma = math.exp(-2 * decay)
            one_minus_gamma = -math.expm1(-2 * decay)
            beta = 2 * math.exp(-decay) * math.cos(angle) / (1 + gamma)
            sb = math.sqrt(one_minus_gamma**2 + 4 * gamma * math.sin(angle) ** 2) / (1 + gamma)
        blocks[i, 0] = gamma
        blocks[i, 1] = beta
        blocks[i, 2] = math.sqrt(one_minus_gamma * (1 + gamma))
        blocks[i, 3] = sb
    return blocks
