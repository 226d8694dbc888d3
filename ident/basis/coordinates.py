"""Where the pole search looks: boxes from the data, and maps from the unit cube to poles.

DIRECT samples a unit cube; `SearchSpace` says which poles a point of it stands for, and `search_space` makes
the box from the length of the records. Coordinates "log": log10(1 - a) for a real pole, (log10 omega, log10
zeta) for a pair, omega in rad/sample. Coordinates "raw": the paper's own x, and (beta, gamma) of (29) (Ziaei
and Wang, 2006). Poles of equal type are ordered by the triangular map s2 = s1 + (hi - s1) x2 on their first
coordinate: two equal real poles are a saddle that DIRECT would sample and a descent cannot leave.
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
from ident.data.arrays import COMPILED, ComplexArray, RealArray, kernel_array, lock

# Largest damping ratio of a pair: closer to critical damping it is two real poles in disguise, and its two
# columns become dependent. Chosen; `IdentOptions.zeta_max` has it as its limit.
ZETA_LIMIT = 0.98
# Least damping ratio of a pair: links have more, and an undamped pair with a free initial state fits any slow
# disturbance (docs/decisions.md). A user who knows a lighter mode states `zeta_min`.
ZETA_LEAST = 1e-3
# Shortest record whose length shapes the box, samples: of fewer, the box would be empty or nearly so (from 4
# down no frequency is left between two periods and the highest share). Chosen.
_SHORTEST = 30
# Slowest real pole of the box: it decays by this share of its value over the longest record. Slower ones look
# like an offset there; a refinement may go on to a thousandth (`ident.fit.refinement.Bounds`). Chosen.
_LEAST_DECAY_PER_RECORD = 0.2
# Fastest real pole of the box, as 1 - a: down to .3 of its value within a sample. A refinement may go on.
# Chosen.
_LARGEST_DISTANCE = 0.7
# Lowest frequency of the box, periods within the longest record: with fewer a pair looks like a drift.
# Chosen; a refinement may go on to a tenth of a radian.
_LEAST_PERIODS = 2
# Highest frequency of the box, as a share of the Nyquist frequency: a mode there is hard to tell from one
# that is folded back. Chosen.
_HIGHEST_SHARE = 0.9

# Share of the Nyquist frequency up to which a stated bound may go: what was stated is more than the box
# knows, but at the Nyquist frequency itself a pair is a real pole. Chosen.
_HIGHEST_STATED_SHARE = 0.99
# Largest damping ratio of the box; a refinement may go on to ZETA_LIMIT. Chosen: more rings no more.
_LARGEST_ZETA = 0.63
# Damping ratio to which a pair of the raw box is moved that is real, or complex with more than this. Chosen
# below `ZETA_LIMIT`, so that a refinement begins inside its bounds.
_MOVED_ZETA = 0.95
# Least damping ratio of a pair that is moved: it has to lie inside the circle, to be a pole of `Poles`. Any
# small number will do; the refinement has a bound of its own.
_LEAST_MOVED_ZETA = 1e-6

# Highest frequency of a pair that is moved, over pi: it has to lie above the axis, and where the box of the
# other coordinates ends (`_HIGHEST_SHARE`) is far enough.
_HIGHEST_MOVED_SHARE = 0.9
# Modulus in place of a pole at z = 0, which has no logarithm. Any small one: its frequency, 6.9 rad/sample,
# is above the limit and is cut.
_DEADBEAT_MODULUS = 1e-3


@dataclass(frozen=True, eq=False)
class SearchSpace:
    """Box of a search for n_real real poles and n_pairs pairs.

    Raises ValueError where a lower bound is not below its upper one.

    Attributes
    ----------
    n_real, n_pairs : int
        Numbers R of real poles and P of pairs; a point has D = R + 2 P coordinates: those of the real poles,
        then two of each pair.
    low, high : ndarray, shape (3,)
        Ends of the box of one pole of each type, [real, pair first, pair second] in the coordinates of the
        module text; frequencies in rad/sample.
    raw : bool
        The coordinates are the paper's, not logarithms.
    dt_s : float
        Sampling time, s.
    """

    n_real: int
    n_pairs: int
    low: RealArray
    high: RealArray
    raw: bool
    dt_s: float

    def __post_init__(self) -> None:
        """Lock the ends and refuse an empty box, or one with NaN. Raises ValueError as the class says."""
        lock(self, "low", "high")
        is_open = self.low < self.high
        if not np.all(is_open):
            names = ("real pole", "pair frequency", "pair damping")
            i = int(np.flatnonzero(~is_open)[0])
            raise ValueError(
                f"the search box of the {names[i]} is empty: its lower bound is not below its upper bound"
            )

    @property
    def dimension(self) -> int:
        """Number of coordinates D of a point."""
        return self.n_real + 2 * self.n_pairs

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each coordinate, (D,), with its unit and the number of its pole."""
        if self.raw:
            of_real = "x"
            of_pair = ("beta", "gamma")
        else:
            of_real = "log10(1 - a)"
            of_pair = ("log10(omega [rad/s])", "log10(zeta)")
        reals = [f"{of_real} {i + 1}" for i in range(self.n_real)]
        pairs = [f"{name} {i + 1}" for i in range(self.n_pairs) for name in of_pair]
        return (*reals, *pairs)

    def _at(self, units: RealArray) -> RealArray:
        """Coordinates of one point (D,) of the unit cube, or of as many as there are columns (D, E).

        Of the module text, frequencies in rad/sample. Points outside the cube lie outside the box; nothing is
        checked.
        """
        return np.asarray(_coordinates_of_point(units, self.n_real, self.low, self.high))

    def blocks(self, unit: RealArray) -> RealArray:
        """Cascade blocks (R + P, 4) of a point (D,) of the unit cube, as compiled code takes them.

        `blocks_of_point` says what is in them. That the point is in the cube, or of D numbers, is not
        checked.
        """
        point = kernel_array(unit)
        blocks = blocks_of_point(point, self.n_real, self.low.copy(), self.high.copy(), self.raw)
        return np.asarray(blocks)

    def poles(self, unit: RealArray) -> Poles:
        """Poles of a point (D,) of the unit cube.

        A pair of the raw box that is not complex, or nearly not, is put at a damping ratio of .95 with the
        frequency |log p| it has: what follows needs a pair above the axis. Raises ValueError, by `Poles`,
        where a point outside the cube, or NaN, gives a pole outside the circle; D is not checked.
        """
        if not self.raw:
            point = self._at(unit)
            distance = 10.0 ** point[: self.n_real]
            omega = 10.0 ** point[self.n_real :: 2]
            zeta = 10.0 ** point[self.n_real + 1 :: 2]
            return Poles(1 - distance, _pairs(omega, zeta))

        # p = beta (1 + gamma)/2 + j sqrt(gamma - re^2) from (29), where that is above the axis.
        blocks = self.blocks(unit)
        gamma = blocks[self.n_real :, 0]
        beta = blocks[self.n_real :, 1]
        re = beta * (1 + gamma) / 2
        im = np.sqrt(np.maximum(gamma - re**2, 0.0))
        pairs = re + 1j * im

        with np.errstate(divide="ignore"):
            log = np.log(np.where(pairs == 0, _DEADBEAT_MODULUS, pairs))
        modulus = np.abs(log)
        is_complex = im > 0
        is_below_limit = -log.real < _MOVED_ZETA * modulus
        is_proper = is_complex & is_below_limit
        omega = np.minimum(modulus, _HIGHEST_MOVED_SHARE * np.pi)
        zeta = np.clip(-log.real / omega, _LEAST_MOVED_ZETA, _MOVED_ZETA)
        return Poles(blocks[: self.n_real, 0], np.where(is_proper, pairs, _pairs(omega, zeta)))

    def levels(self, poles: Poles) -> RealArray:
        """Where poles lie between the ends of the box by their first coordinate, (R + P,), 0 to 1; never NaN.

        `poles` may be of any number, R and P theirs. Those outside the box have the 0 or 1 of the side they
        are on.
        """
        if self.raw:
            beta = 2 * poles.pairs.real / (1 + np.abs(poles.pairs) ** 2)
            first = np.concatenate([poles.real, beta])
        else:
            omega = np.abs(np.log(poles.pairs))
            first = np.log10(np.concatenate([1 - poles.real, omega]))
        low = np.repeat(self.low[:2], poles.counts)
        high = np.repeat(self.high[:2], poles.counts)
        return np.asarray(np.clip((first - low) / (high - low), 0, 1))

    def coordinates(self, units: RealArray) -> RealArray:
        """Coordinates (E, D) of points (E, D) of the unit cube; frequencies in rad/s, as `names` says.

        For plots; points outside the cube are not refused.
        """
        points = self._at(units.T).T
        if not self.raw:
            points[:, self.n_real :: 2] -= np.log10(self.dt_s)
        return points


def _pairs(omega: RealArray, zeta: RealArray) -> ComplexArray:
    """Poles (P,) above the axis, of frequencies omega (P,) in rad/sample and damping ratios zeta (P,) < 1.

    A damping ratio above 1 gives NaN, a damped frequency of pi or more a pole below the axis: `Poles` refuses
    both.
    """
    return np.asarray(np.exp(omega * (-zeta + 1j * np.sqrt(1 - zeta**2))))


def search_space(n_real: int, n_pairs: int, longest: int, dt_s: float, options: IdentOptions) -> SearchSpace:
    """Box from record length and sampling time; bounds given in the options replace its sides.

    Parameters
    ----------
    n_real, n_pairs : int
        Numbers of poles that are sought.
    longest : int
        Samples N of the longest record; fewer than `_SHORTEST` count as so many.
    dt_s : float
        Sampling time, s, positive: not checked.
    options : IdentOptions
        `coordinates`, and the bounds decay_min_per_s to zeta_max, None where nothing was stated.

    Returns
    -------
    SearchSpace
        Without bounds 1 - a in [0.2/N, 0.7], omega in [4 pi/(N dt), 0.9 pi/dt], zeta in [1e-3, 0.63]; raw: x
        and beta up to 1 - 0.2/N, gamma from 0 to that.

    Raises
    ------
    ValueError
        A stated bound leaves its side of the box empty.
    """
    n = max(longest, _SHORTEST)
    if options.coordinates == "raw":
        edge = 1 - _LEAST_DECAY_PER_RECORD / n
        low_raw = np.array([0.0, -edge, 0.0])
        high_raw = np.array([edge, edge, edge])
        return SearchSpace(n_real, n_pairs, low_raw, high_raw, raw=True, dt_s=dt_s)

    lowest_angle = 2 * _LEAST_PERIODS * np.pi / n
    low = [np.log10(_LEAST_DECAY_PER_RECORD / n), np.log10(lowest_angle), np.log10(ZETA_LEAST)]
    high = [np.log10(_LARGEST_DISTANCE), np.log10(_HIGHEST_SHARE * np.pi), np.log10(_LARGEST_ZETA)]
    for side, end in ((low, "min"), (high, "max")):
        decay_per_s = getattr(options, f"decay_{end}_per_s")
        if decay_per_s is not None:
            side[0] = np.log10(-np.expm1(-decay_per_s * dt_s))
        omega_rad_s = getattr(options, f"omega_{end}_rad_s")
        if omega_rad_s is not None:
            side[1] = np.log10(min(omega_rad_s * dt_s, _HIGHEST_STATED_SHARE * np.pi))
        zeta = getattr(options, f"zeta_{end}")
        if zeta is not None:
            side[2] = np.log10(zeta)
    return SearchSpace(n_real, n_pairs, np.array(low), np.array(high), raw=False, dt_s=dt_s)


@register_jitable(inline="always")
def _coordinates_of_point(unit: Any, n_real: int, low: Any, high: Any) -> Any:
    """Coordinates (D,) of a point (D,) of the unit cube in the box low, high (3,).

    The first coordinate of each pole lies between that of the pole before, of its type, and the end. n_real:
    R, how many of the coordinates are real poles'. Also of columns (D, E). Compiled: nothing is checked.
    """
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
    """Cascade blocks (R + P, 4) of a point (D,) of the unit cube in the box low, high (3,).

    Rows as `ident.basis.functions.block_parameters` makes them of poles: [a, sqrt(1 - a^2), 0, 0] of a real
    pole, [gamma, beta, sqrt(1 - gamma^2), sqrt(1 - beta^2)] of a pair; from the coordinates, so that a pole
    near the circle loses no digits. n_real: R; raw: the coordinates are the paper's. Compiled: nothing is
    checked; points outside the cube, and NaN, give blocks that are no basis.
    """
    point = _coordinates_of_point(unit, n_real, low, high)
    blocks = np.zeros((n_real + (unit.size - n_real) // 2, 4))
    for i in range(n_real):
        distance = 1.0 - point[i] if raw else 10.0 ** point[i]
        blocks[i, 0] = 1.0 - distance
        blocks[i, 1] = math.sqrt(distance * (2.0 - distance))
    for i in range(n_real, blocks.shape[0]):
        first = point[2 * i - n_real]
        second = point[2 * i - n_real + 1]
        if raw:
            beta = first
            gamma = second
            sb = math.sqrt((1 - beta) * (1 + beta))
            one_minus_gamma = 1 - gamma
        else:
            # p = exp(-decay + j angle): gamma = |p|^2, beta = 2 Re p / (1 + gamma).
            omega = 10.0**first
            zeta = 10.0**second
            decay = zeta * omega
            angle = omega * math.sqrt(1 - zeta * zeta)
            gamma = math.exp(-2 * decay)
            one_minus_gamma = -math.expm1(-2 * decay)
            beta = 2 * math.exp(-decay) * math.cos(angle) / (1 + gamma)
            # 1 - beta^2 without cancellation.
            sb = math.sqrt(one_minus_gamma**2 + 4 * gamma * math.sin(angle) ** 2) / (1 + gamma)
        blocks[i, 0] = gamma
        blocks[i, 1] = beta
        blocks[i, 2] = math.sqrt(one_minus_gamma * (1 + gamma))
        blocks[i, 3] = sb
    return blocks
