"""What any controller could reach: bounds on the worst case over the ellipses that know no order.

Every controller that stabilises the nominal plant is K = (X + M Q)/(Y - N Q) with Q stable, and K S, S are
affine in Q. For a member G = G_0 + D of the ellipse, S_G = S/(1 + D K S) and K S_G = K S/(1 + D K S), so with
q = K S of the centre the worst case is at most gamma where

    |W1 S| <= gamma m,  |W3 q| <= gamma m,  m = smallest |1 + D q| over the ellipse.

For a disc of radius r, m = 1 - r |q| and the problem is convex: the disc inscribed in the ellipse gives a
value that no controller goes below, the enclosing one a value some controller reaches. For the ellipse m =
max over t of Re(e^{-jt}) - |half-axes of e^{-jt} q|, convex in Q for fixed t: from the enclosing disc's
answer, t and Q in turn lead down to a local optimum, a controller's value again. A larger basis lowers all
three a little: 0.1 % on the example link from 57 to 91 functions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from control_design.analysis.worst_case import Grids, PlantData, worst_of
from control_design.convex.convex_options import YoulaOptions
from control_design.convex.minimax import MinimaxPoint, PlaneRows, exchanged, plane, smallest_ratio
from control_design.convex.youla_basis import (
    AffineLoop,
    Factors,
    chosen_poles,
    coprime_factors,
    with_constant,
)
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant, delayed
from control_design.specification import Specification
from control_design.specification.requirement import LoopFunction
from ident.data.arrays import factor_matrices
from ident.data.shown import Shown

_ELLIPSE_ROUNDS = 20  # turns of angles and Q
Region = Literal["inscribed", "ellipse", "enclosing"]


@dataclass(frozen=True)
class PlantBracket:
    """Values for one plant, each the largest on the dense grid, by a Q of the basis: a longer one may lie a
    little lower, by a per cent at most on the plants tried; inf where nothing was found to be robustly
    stable. Of unstable plants whose ellipses are not about the nominal response `inscribed` is a local
    optimum."""

    plant: str
    inscribed: float
    ellipse: float
    enclosing: float


@dataclass(frozen=True, repr=False)
class YoulaBracket(Shown):
    """What any controller could reach, the worst over the plants; each may need a Q of its own, so that with
    several these are lower bounds of what one controller can do."""

    plants: tuple[PlantBracket, ...]

    @property
    def inscribed(self) -> float:
        return max(plant.inscribed for plant in self.plants)

    @property
    def ellipse(self) -> float:
        return max(plant.ellipse for plant in self.plants)

    @property
    def enclosing(self) -> float:
        return max(plant.enclosing for plant in self.plants)

    @property
    def floor(self) -> float:
        """The best lower bound, that of the inscribed discs; but for basis and grid: see `PlantBracket`."""
        return self.inscribed


def youla_bracket(
    plants: UncertainPlant | Sequence[UncertainPlant],
    specification: Specification,
    options: YoulaOptions | None = None,
    *,
    progress: Callable[[float, str], None] | None = None,
) -> YoulaBracket:
    """Bracket of the smallest possible worst case over the ellipses, whatever the controller's order.

    Only weighted requirements count, so that the values are lower bounds for what is asked further. Functions
    with the member as a factor (G S, T) enter the inscribed value by the centre alone, the others by the
    largest |G|. Raises SpecificationError if specification and plants contradict each other.
    """
    options = options or YoulaOptions()
    listed = (plants,) if isinstance(plants, UncertainPlant) else tuple(plants)
    specification.check_against(listed)
    tell = progress or (lambda fraction, message: None)
    results = []
    for number, plant in enumerate(listed):
        tell(number / len(listed), f"Youla bracket of {plant.name}")
        results.append(BracketProblem(plant, specification, options).solve())
    tell(1.0, "Youla bracket")
    return YoulaBracket(tuple(results))


class BracketProblem:
    """One plant: parametrisation, grids and the three problems."""

    def __init__(
        self,
        plant: UncertainPlant,
        specification: Specification,
        options: YoulaOptions,
        *,
        accuracy: float = 1e-5,
    ) -> None:
        self.plant, self.spec, self.options = plant, specification, options
        self.accuracy = accuracy
        self.grids = Grids((plant,), specification, options)
        self.factors: Factors | None = None
        if np.any(np.abs(plant.poles) >= 1.0 - 1e-9):
            self.factors = coprime_factors(delayed(plant.nominal, specification.computational_delay_samples))
        self.dense = self.grids.dense[0]
        if np.any(self.dense.largest(LoopFunction.EFFORT) > 0):  # then Q does not invert up to Nyquist
            options = options.model_copy(update={"mirrored_poles": 0})
        self.poles = chosen_poles(plant, self.grids.scale_rad_s, options)
        self.dense_loop = self._loop(self.dense)
        self.dense_basis = self._basis(self.dense)

    def solve(self) -> PlantBracket:
        (ellipse, _), (enclosing, _), (inscribed, _) = self.answers()
        ellipse = min(ellipse, enclosing)  # the same Q does no worse on a smaller region
        return PlantBracket(
            self.plant.name,
            min(inscribed, ellipse),
            ellipse,
            enclosing,
        )

    def answers(self) -> list[tuple[float, Real]]:
        """Of ellipses, enclosing and inscribed discs: see `exchanged`."""
        enclosing = self.exchanged("enclosing", None)
        # Where the enclosing discs cannot be stabilised, the ellipses may be: started from the inscribed.
        inscribed = self.exchanged("inscribed", None)
        start = enclosing if np.isfinite(enclosing[0]) else inscribed
        return [self.exchanged("ellipse", start[1]), enclosing, inscribed]

    def controller(self, x: Real) -> tuple[Real, Complex]:
        """Frequencies (F,) of the programme and K (F,) there."""
        lean = self.grids.lean()[0]
        loop, q = self._loop(lean), self._basis(lean) @ x
        sensitivity = loop.sensitivity + loop.sensitivity_slope * q
        return lean.ellipses.omega_rad_s, (loop.effort + loop.effort_slope * q) / sensitivity

    def exchanged(self, region: Region, start: Real | None) -> tuple[float, Real]:
        """Optimum with violated frequencies added: (value on the dense grid, x)."""

        def solve(begin: Real | None) -> MinimaxPoint:
            lean = self.grids.lean()[0]
            if region == "ellipse":
                return self._ellipse(lean, begin)
            rows = self._rows(lean, region, self._loop(lean))
            return smallest_ratio(self._basis(lean), rows, begin, accuracy=self.accuracy)

        found = exchanged(
            solve,
            lambda x: [self._dense_values(x, region)],
            self.grids.grids,
            [self.dense.ellipses.omega_rad_s],
            rounds=self.options.exchange_rounds,
            most=24,
            start=start,
        )
        x = start if found.x is None else found.x
        return found.worst, np.zeros(self.dense_basis.shape[1]) if x is None else x

    def _ellipse(self, data: PlantData, start: Real | None) -> MinimaxPoint:
        basis, loop = self._basis(data), self._loop(data)
        point = MinimaxPoint(np.zeros(basis.shape[1]), np.inf)
        for _ in range(_ELLIPSE_ROUNDS):
            angles = None if start is None else _best_angles(loop, data, basis @ start)
            rows = self._rows(data, "ellipse", loop, angles)
            new = smallest_ratio(basis, rows, start, accuracy=self.accuracy)
            before = point.gamma
            if new.gamma < before:
                point, start = new, new.x
            if not new.gamma < before * (1 - 10 * self.accuracy):
                break
        return point

    def _loop(self, data: PlantData) -> AffineLoop:
        if self.factors is None:  # a stable plant: M = Y = 1, X = 0, hence K S = Q and S = 1 - G Q
            response = data.ellipses.centre * data.delay
            one, zero = np.ones_like(response), np.zeros_like(response)
            return AffineLoop(response, zero, one, one, -response)
        return self.factors.loop(data.ellipses.omega_rad_s)

    def _basis(self, data: PlantData) -> Complex:
        return with_constant(self.poles, data.ellipses.omega_rad_s, self.plant.dt_s)

    def _rows(
        self, data: PlantData, region: Region, loop: AffineLoop, angles: Real | None = None
    ) -> PlaneRows:
        """Rows of one region on a grid, where the loop is this, in the plane of Q = basis x."""
        e = data.ellipses
        size = e.omega_rad_s.size
        turn = np.exp(-1j * (np.zeros(size) if angles is None else angles))
        offset = e.centre * data.delay - loop.base
        if np.max(np.abs(offset * loop.effort_slope), initial=0.0) < 1e-12:
            offset = np.zeros(size, complex)
        major, minor = e.semi_major, e.semi_minor
        if region != "ellipse":
            major = minor = minor if region == "inscribed" else major
        # e^{-jt} q u in the ellipse's own axes: Re * major, Im * minor.
        along = turn * e.direction * data.delay
        axes = np.stack([major, minor], axis=-1)[:, :, None]
        reach = axes * factor_matrices(along * loop.effort_slope)
        reach_0 = axes[:, :, 0] * plane(along * loop.effort)
        lift = turn * offset * loop.effort_slope
        level = np.real(turn * (1.0 + offset * loop.effort))
        slope = np.stack([lift.real, -lift.imag], axis=-1)
        at = np.arange(size)
        far = {"inscribed": np.abs(e.centre), "enclosing": np.abs(e.centre) + e.semi_major}
        rows_of, extra = [], []  # weight, value, change with Q, share of the ellipse that moves
        for own, with_member, value, change in (
            (LoopFunction.SENSITIVITY, LoopFunction.DISTURBANCE, loop.sensitivity, loop.sensitivity_slope),
            (LoopFunction.EFFORT, LoopFunction.COMPLEMENTARY, loop.effort, loop.effort_slope),
        ):
            weight, still = data.largest(own), data.largest(with_member)
            if np.any(still > 0):
                still = still * (far[region] if region in far else e.farthest())
                if region == "inscribed":  # by the centre alone: at no distance from the others
                    extra.append((still, value, change, 0.0))
                else:
                    weight = np.maximum(weight, still)
            rows_of.append((weight, value, change, 1.0))
        parts: list[PlaneRows] = []
        for weight, value, change, moved in rows_of + extra:
            use = weight > 0
            numerator = factor_matrices(weight * change)[use], plane(weight * value)[use]
            below = level[use], slope[use], moved * reach[use], moved * reach_0[use]
            parts.append(PlaneRows(at[use], *numerator, *below))
        return PlaneRows.stacked(parts)

    def _dense_values(self, x: Real, region: Region) -> Real:
        """Worst case per frequency of the dense grid: exact geometry for the ellipse, the rows for discs."""
        y, loop = self.dense_basis @ x, self.dense_loop
        if region == "ellipse":
            sensitivity = loop.sensitivity + loop.sensitivity_slope * y
            k = (loop.effort + loop.effort_slope * y) / np.where(sensitivity == 0, 1e-300, sensitivity)
            return worst_of(self.dense.weighted(k))
        rows, values = self._rows(self.dense, region, loop), np.zeros(y.size)
        np.maximum.at(values, rows.at, rows.ratio(plane(y)))
        return values


def _best_angles(loop: AffineLoop, data: PlantData, y: Complex) -> Real:
    """Angle t of the supporting normal that gives the exact distance, (F,): largest m(t)."""
    e = data.ellipses
    q = loop.effort + loop.effort_slope * y
    c = 1.0 + (e.centre * data.delay - loop.base) * q
    v = q * e.direction * data.delay
    best, width = np.angle(c), np.pi / 2
    for _ in range(6):
        trial = best[:, None] + width * np.linspace(-1, 1, 21)
        turned = np.exp(-1j * trial)
        reach = turned * v[:, None]
        margin = np.real(turned * c[:, None]) - np.hypot(
            e.semi_major[:, None] * reach.real, e.semi_minor[:, None] * reach.imag
        )
        best = np.take_along_axis(trial, np.argmax(margin, axis=1)[:, None], axis=1)[:, 0]
        width /= 8.0
    return np.asarray(best)
