"""What any controller could reach: bounds on the worst case over the ellipses that know no order.

Every controller that stabilises the nominal plant is K = (X + M Q)/(Y - N Q) with Q stable, and K S and S are
affine in Q. For a member G = G_0 + D of the ellipse, S_G = S/(1 + D K S) and K S_G = K S/(1 + D K S), so with
q = K S of the centre the worst case is at most gamma where

    |W1 S| <= gamma m,  |W3 q| <= gamma m,  m = smallest |1 + D q| over the ellipse.

For a disc of radius r, m = 1 - r |q| and the problem is convex: the disc inscribed in the ellipse gives a
value that no controller goes below, the enclosing one a value some controller reaches. For the ellipse m =
max over t of Re(e^{-jt}) - |half axes of e^{-jt} q|, convex in Q for fixed t: from the enclosing disc's
answer, t and Q in turn lead down to a local optimum, a controller's value again. `youla_bracket` gives these
three values for every plant, `BracketProblem` also the controller on a grid that attains one. A larger basis
lowers all three a little: 0.1 % on the example link from 57 to 91 functions.
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

# Requirements that the bounds do not know: with other values of these they are the same.
UNKNOWN_TO_BOUND = (
    "controller_order",
    "structure",
    "fixed",
    "notches",
    "low_pass",
    "controller_damping",
    "delay_margin_s",
    "mode_damping",
    "input_limit",
    "rate_limit",
)

# Turns of angles and Q at most; it ends earlier once a turn gains less than ten times the accuracy. A local
# optimum that is not reached leaves a value that is a little too high, and still some controller's. Chosen.
_ELLIPSE_ROUNDS = 20

# The angles are searched by refinement: so many times, on so many points, each time within an eighth of the
# width before: from a quarter turn down to 5e-5 of it. The margin is flat at its maximum, so this is exact to
# 1e-8.
_ANGLE_REFINEMENTS = 6

# Points of each refinement: a tenth of the width apart, less than the eighth that the next one spans.
_ANGLE_POINTS = 21

# Factor by which each refinement is narrower; at most the half number of points, so that no maximum is lost.
_ANGLE_NARROWING = 8.0

# Largest |offset| of the ellipses' centres from the base plant, times |d(K S)/dQ|, up to which they stand on
# it: rounding, which would make denominators depend on Q.
_ON_BASE_SHARE = 1e-12

# A pole nearer to the unit circle than this is not stable: the loop is parametrised by coprime factors. Above
# the rounding of an integrator's pole, below any distance that a machine has.
_UNSTABLE_DISTANCE = 1e-9

# Frequencies that are added to the programme's grid in a round, at most: each makes the next programme
# dearer. Chosen.
_MOST_ADDED = 24

Region = Literal["inscribed", "ellipse", "enclosing"]
"""What of each ellipse is looked at: the disc inside of it, itself, or the disc around it."""


@dataclass(frozen=True)
class PlantBracket:
    """What controllers reach on one plant: weighted worst cases, each the largest on the dense grid.

    Values have no unit; 1 is what the specification asks. plant : its name. inscribed : no controller goes
    below. ellipse, enclosing : some controller reaches it. Each is by a Q of the basis: a longer one may lie
    a little lower, by a per cent at most on the plants tried. inf where nothing was found to be robustly
    stable. For unstable plants whose ellipses are not about the nominal response, `inscribed` is a local
    optimum.
    """

    plant: str
    inscribed: float
    ellipse: float
    enclosing: float


@dataclass(frozen=True, repr=False)
class YoulaBracket(Shown):
    """What any controller could reach, the worst over the plants. Each may need a Q of its own, so that with
    several plants these are lower bounds of what one controller can do. At least one plant; inf where one of
    them has none that is robustly stable."""

    plants: tuple[PlantBracket, ...]

    @property
    def inscribed(self) -> float:
        """Largest over the plants of the values that no controller goes below."""
        return max(plant.inscribed for plant in self.plants)

    @property
    def ellipse(self) -> float:
        """Largest over the plants of the values that some controller reaches on the ellipses."""
        return max(plant.ellipse for plant in self.plants)

    @property
    def enclosing(self) -> float:
        """Largest over the plants of the values that some controller reaches on the discs around the
        ellipses."""
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

    Parameters
    ----------
    plants : UncertainPlant or sequence of them
        Each is bracketed by itself, with a grid and a basis of its own.
    specification : Specification
        Only its weighted requirements count, so that the values are lower bounds for what is asked further.
    options : YoulaOptions or None
        Sizes of basis and grids.
    progress : callable or None
        Told the finished share and a line of words.

    Returns
    -------
    YoulaBracket
        A value for each plant and region.

    Raises
    ------
    SpecificationError
        If there is no plant, or specification and plants contradict each other.
    ValueError
        If a plant has a mode on or outside the circle that no controller moves (`coprime_factors`).

    Notes
    -----
    Functions with the member as a factor (G S, T) enter the inscribed value by the centre alone, the others
    by the largest |G|: the bracket is a little wider for them.
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
    """The three programmes of one plant, with its grids and the parametrisation of its controllers.

    Q is expanded in n functions: the constant one and those of `poles`. `dense` is the plant's data on the
    grid of the checks, `dense_loop` and `dense_basis` what depends on Q there.
    """

    def __init__(
        self,
        plant: UncertainPlant,
        specification: Specification,
        options: YoulaOptions,
        *,
        accuracy: float = 1e-5,
    ) -> None:
        """Grids, loop and basis of one plant; accuracy is that of each programme's gamma, relative: by
        default a thousandth of the per cent by which bounds are compared. Raises ValueError for a mode on or
        outside the circle that no controller moves (`coprime_factors`)."""
        self.plant = plant
        self.spec = specification
        self.options = options
        self.accuracy = accuracy
        self.grids = Grids((plant,), specification, options)
        self.factors: Factors | None = None
        if np.any(np.abs(plant.poles) >= 1.0 - _UNSTABLE_DISTANCE):
            self.factors = coprime_factors(delayed(plant.nominal, specification.computational_delay_samples))
        self.dense = self.grids.dense[0]
        # A weight on the effort keeps Q from inverting the plant up to Nyquist.
        if np.any(self.dense.largest(LoopFunction.EFFORT) > 0):
            options = options.model_copy(update={"mirrored_poles": 0})
        self.poles = chosen_poles(plant, self.grids.scale_rad_s, options)
        self.dense_loop = self._loop(self.dense)
        self.dense_basis = self._basis(self.dense)

    def solve(self) -> PlantBracket:
        """The three values of this plant. The same Q does no worse on a smaller region, so none may exceed
        that of a larger one."""
        (ellipse, _), (enclosing, _), (inscribed, _) = self.answers()
        ellipse = min(ellipse, enclosing)
        return PlantBracket(
            self.plant.name,
            min(inscribed, ellipse),
            ellipse,
            enclosing,
        )

    def answers(self) -> list[tuple[float, Real]]:
        """(value, x (n,)) for ellipses, enclosing and inscribed discs, in this order: the worst case on the
        dense grid, inf where nothing is robustly stable, and the coefficients of Q; see `exchanged`."""
        enclosing = self.exchanged("enclosing", None)
        inscribed = self.exchanged("inscribed", None)
        # Where the enclosing discs cannot be stabilised, the ellipses may be: started from the inscribed.
        enclosing_value, start = enclosing
        if not np.isfinite(enclosing_value):
            _, start = inscribed
        return [self.exchanged("ellipse", start), enclosing, inscribed]

    def controller(self, x: Real) -> tuple[Real, Complex]:
        """Frequencies (F,) of the programme in rad/s and the controller's values K (F,) there, for x (n,).

        K is without the computational delay, command per error; infinite or nan where S vanishes.
        """
        lean = self.grids.lean()[0]
        loop = self._loop(lean)
        q = self._basis(lean) @ x
        sensitivity = loop.sensitivity + loop.sensitivity_slope * q
        return lean.ellipses.omega_rad_s, (loop.effort + loop.effort_slope * q) / sensitivity

    def exchanged(self, region: Region, start: Real | None) -> tuple[float, Real]:
        """Value on the dense grid and x (n,) of the optimum for a region, with violated frequencies added.

        start : x to begin from, or None. Where no x is found the start is given back with an infinite value,
        or zeros.
        """

        def solve(begin: Real | None) -> MinimaxPoint:
            """Optimum on the lean grid as it is, from x (n,) or None; gamma is inf where none was found."""
            lean = self.grids.lean()[0]
            if region == "ellipse":
                return self._ellipse(lean, begin)
            rows = self._rows(lean, region, self._loop(lean))
            return smallest_ratio(self._basis(lean), rows, begin, accuracy=self.accuracy)

        best = exchanged(
            solve,
            lambda x: [self._dense_values(x, region)],
            self.grids.grids,
            [self.dense.ellipses.omega_rad_s],
            rounds=self.options.exchange_rounds,
            most=_MOST_ADDED,
            start=start,
        )
        x = start if best.x is None else best.x
        if x is None:
            x = np.zeros(self.dense_basis.shape[1])
        return best.worst, x

    def _ellipse(self, data: PlantData, start: Real | None) -> MinimaxPoint:
        """Local optimum for the ellipses on the grid of `data`: the best normals for x, then the best x for
        these normals, in turn. start : x (n,), or None: the normals begin along the real axis. gamma is inf,
        with x of zeros, where no x makes the loop robustly stable."""
        basis = self._basis(data)
        loop = self._loop(data)
        best = MinimaxPoint(np.zeros(basis.shape[1]), np.inf)
        for _ in range(_ELLIPSE_ROUNDS):
            angles = None
            if start is not None:
                angles = _best_angles(loop, data, basis @ start)
            rows = self._rows(data, "ellipse", loop, angles)
            point = smallest_ratio(basis, rows, start, accuracy=self.accuracy)
            gamma_before = best.gamma
            if point.gamma < gamma_before:
                best = point
                start = point.x
            # Ten times the accuracy of a programme: less may be its error.
            if not point.gamma < gamma_before * (1 - 10 * self.accuracy):
                break
        return best

    def _loop(self, data: PlantData) -> AffineLoop:
        """How the loop depends on Q at the frequencies of `data` (its `ellipses.omega_rad_s` (F,) count, for
        a stable plant their centres and the computational delay, too)."""
        if self.factors is not None:
            return self.factors.loop(data.ellipses.omega_rad_s)
        # A stable plant needs no factors: M = Y = 1 and X = 0, hence K S = Q and S = 1 - G Q.
        response = data.ellipses.centre * data.delay
        return AffineLoop(
            base=response,
            effort=np.zeros_like(response),
            effort_slope=np.ones_like(response),
            sensitivity=np.ones_like(response),
            sensitivity_slope=-response,
        )

    def _basis(self, data: PlantData) -> Complex:
        """Values (F, n) of the basis of Q at the frequencies of `data`, its `ellipses.omega_rad_s` (F,)."""
        return with_constant(self.poles, data.ellipses.omega_rad_s, self.plant.dt_s)

    def _rows(
        self, data: PlantData, region: Region, loop: AffineLoop, angles: Real | None = None
    ) -> PlaneRows:
        """Rows of the programme of one region on a grid, as ratios of y = Q.

        Parameters
        ----------
        data : PlantData
            Ellipses, delay and weights at F frequencies.
        region : Region
            What of the ellipses counts.
        loop : AffineLoop
            K S and S as they depend on Q, at these frequencies.
        angles : (F,) array or None
            t of the normal for the ellipse, radians; None: zero, the best one for discs about the base
            plant.

        Returns
        -------
        PlaneRows
            One for each weighted function and frequency with a weight above 0; a specification always weighs
            S (modulus margin), so there are some.

        Notes
        -----
        Numerators are |W S| and |W K S|. Denominators are m = Re(e^{-jt} (1 + offset q)) - |half axes of
        e^{-jt} q|, with q = K S and offset the distance of the ellipse's centre from the base plant.
        """
        ellipses = data.ellipses
        size = ellipses.omega_rad_s.size
        turn = np.exp(-1j * (np.zeros(size) if angles is None else angles))
        offset = ellipses.centre * data.delay - loop.base
        if np.max(np.abs(offset * loop.effort_slope), initial=0.0) < _ON_BASE_SHARE:
            offset = np.zeros(size, complex)
        major = ellipses.semi_major
        minor = ellipses.semi_minor
        if region == "inscribed":
            major = minor
        elif region == "enclosing":
            minor = major
        # Denominator: e^{-jt} q u in the ellipse's own axes, its real part times the major, its imaginary
        # part times the minor half axis.
        along = turn * ellipses.direction * data.delay
        axes = np.stack([major, minor], axis=-1)[:, :, None]
        reach = axes * factor_matrices(along * loop.effort_slope)
        reach_offset = axes[:, :, 0] * plane(along * loop.effort)
        lift = turn * offset * loop.effort_slope
        level = np.real(turn * (1.0 + offset * loop.effort))
        slope = np.stack([lift.real, -lift.imag], axis=-1)
        # Largest |G| of the region, by which a function with the member as a factor is bounded.
        if region == "inscribed":
            largest_member = np.abs(ellipses.centre)
        elif region == "enclosing":
            largest_member = np.abs(ellipses.centre) + ellipses.semi_major
        else:
            largest_member = ellipses.farthest()
        # Each numerator: weight, value without Q, slope with Q, and whether the denominator has its reach.
        numerators = []
        centre_numerators = []
        for function, function_times_member, value, change in (
            (LoopFunction.SENSITIVITY, LoopFunction.DISTURBANCE, loop.sensitivity, loop.sensitivity_slope),
            (LoopFunction.EFFORT, LoopFunction.COMPLEMENTARY, loop.effort, loop.effort_slope),
        ):
            weight = data.largest(function)
            weight_with_member = data.largest(function_times_member)
            if np.any(weight_with_member > 0):
                weight_with_member = weight_with_member * largest_member
                if region == "inscribed":
                    # By the centre alone: a lower bound has no distance to the other members.
                    centre_numerators.append((weight_with_member, value, change, 0.0))
                else:
                    weight = np.maximum(weight, weight_with_member)
            numerators.append((weight, value, change, 1.0))
        positions = np.arange(size)
        parts: list[PlaneRows] = []
        for weight, value, change, reach_factor in numerators + centre_numerators:
            use = weight > 0
            parts.append(
                PlaneRows(
                    at=positions[use],
                    A=factor_matrices(weight * change)[use],
                    a=plane(weight * value)[use],
                    e=level[use],
                    E=slope[use],
                    C=reach_factor * reach[use],
                    c=reach_factor * reach_offset[use],
                )
            )
        return PlaneRows.stacked(parts)

    def _dense_values(self, x: Real, region: Region) -> Real:
        """Worst case (F,) at each frequency of the dense grid for x (n,): by exact geometry for the ellipse,
        by the rows for discs; inf where the region is not robustly stable."""
        q = self.dense_basis @ x
        loop = self.dense_loop
        if region == "ellipse":
            sensitivity = loop.sensitivity + loop.sensitivity_slope * q
            # Where S vanishes K is infinite: huge instead, whose worst case is infinite or huge as well.
            nonzero_sensitivity = np.where(sensitivity == 0, 1e-300, sensitivity)
            k = (loop.effort + loop.effort_slope * q) / nonzero_sensitivity
            return worst_of(self.dense.weighted(k))
        rows = self._rows(self.dense, region, loop)
        values = np.zeros(q.size)
        np.maximum.at(values, rows.at, rows.ratio(plane(q)))
        return values


def _best_angles(loop: AffineLoop, data: PlantData, y: Complex) -> Real:
    """Angles t (F,) in radians of the supporting normals that give the exact distance: those of the largest
    m(t), for Q = y (F,) complex. Nan where y is not finite."""
    ellipses = data.ellipses
    q = loop.effort + loop.effort_slope * y
    # Centre and major axis of the ellipse of 1 + D q, as complex numbers.
    centre = 1.0 + (ellipses.centre * data.delay - loop.base) * q
    axis = q * ellipses.direction * data.delay
    angles = np.angle(centre)
    # A quarter turn to either side of the centre's own direction: the best normal has a part along it
    # wherever the ellipse leaves the origin out.
    width = np.pi / 2
    for _ in range(_ANGLE_REFINEMENTS):
        trial = angles[:, None] + width * np.linspace(-1, 1, _ANGLE_POINTS)
        turned = np.exp(-1j * trial)
        turned_axis = turned * axis[:, None]
        reach = np.hypot(
            ellipses.semi_major[:, None] * turned_axis.real,
            ellipses.semi_minor[:, None] * turned_axis.imag,
        )
        margin = np.real(turned * centre[:, None]) - reach
        best = np.argmax(margin, axis=1)
        angles = np.take_along_axis(trial, best[:, None], axis=1)[:, 0]
        width /= _ANGLE_NARROWING
    return np.asarray(angles)
