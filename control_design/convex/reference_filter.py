"""Second degree of freedom: u = K (F r - y), F chosen so that every member of the ellipses follows a model.

The error of a member G is W (F T - T_ref), T = G K/(1 + G K), which is affine in F. With chosen poles of F it
is a convex minimax over samples of the ellipses' boundaries, where the worst member lies (T is free of poles
by robust stability); poles that are not given are searched by a simplex around it. The certified error is not
sampled: `worst_matching_error` is exact at every frequency of a dense grid. `design_reference_filter` is the
way in, `ReferenceFilter` the result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from control_design.analysis.stability import closed_loop_poles
from control_design.controllers.biquads import imaginary_axis
from control_design.controllers.controller import Controller
from control_design.controllers.law import Law
from control_design.convex.convex_options import ReferenceFilterOptions
from control_design.convex.minimax import MinimaxPoint, PlaneRows, exchanged, plane, smallest_ratio
from control_design.convex.youla_basis import with_constant
from control_design.plants.ellipses import Complex, Ellipses, Real, distance_to_minus_one, largest_ratio
from control_design.plants.frequency_grid import programme_grid
from control_design.plants.plant_set import UncertainPlant
from control_design.plants.weights import RationalWeight
from control_design.specification.requirement import constant_weight
from ident.basis.functions import basis_state_space
from ident.basis.poles import Poles
from ident.data.arrays import factor_matrices, readonly

# Points on the boundary of every ellipse in the programme; the search of poles takes half of them. The
# inscribed polygon misses 1 - cos(pi/24) = 0.9 % of the half axis, and the dense check is exact. Chosen for
# that.
_BOUNDARY_SAMPLES = 24

# Relative accuracy of the certified errors, which are rounded up: no digit that is shown.
_ACCURACY = 1e-7

# The search of poles takes every third frequency of the grids: the optimum is flat in the poles. Chosen.
_SEARCH_THINNING = 3

# Slowest decay rate that is searched, as a share of the Nyquist frequency: 0.03 rad/s at 1 kHz, below any
# model to follow. Chosen.
_SLOWEST_SHARE = 1e-5

# Fastest decay rate that is searched, as a share of the Nyquist frequency: next to it a pole is a delay of
# one sample, which F does not need.
_FASTEST_SHARE = 0.95

# Distance of starts from both ends, in logarithms: a simplex that begins on a limit collapses onto it.
# Chosen.
_LOG_DISTANCE_FROM_ENDS = 0.1

# Factor from pole to pole of a start, around the model's corner times a start's own factor: apart enough to
# tell the poles, near enough to act together. Chosen.
_POLE_SPREAD = 4.0

# Factors on the model's corner at which the three simplexes begin: below, at and above it by about four.
_START_FACTORS = (0.3, 1.0, 4.0)

# Evaluations of the simplex for each pole, at most. Chosen: it mostly ends by its tolerances before.
_EVALUATIONS_PER_POLE = 30

# The simplex ends within 1 % of a decay rate, which moves the error by its square only ...
_LOG_RATE_TOLERANCE = 1e-2

# ... and within this part of the error, a fifth of what the exchange of frequencies accepts.
_ERROR_TOLERANCE = 1e-4

# Frequencies that are added to each plant's grid in a round, at most: each makes the next programme dearer.
# Chosen.
_MOST_ADDED = 12


@dataclass(frozen=True, eq=False)
class ReferenceFilter(Law):
    """Reference filter x+ = A x + B r, filtered reference = C x + D r, one input and one output, stable.

    Beside the matrices and dt_s of `Law` it holds what its design reached:

    Parameters
    ----------
    error_before, error_after : float
        Largest weighted model-matching error over all plants and ellipses, without a filter (F = 1) and with
        it, on the dense grid; no unit.
    worst_rad_s : float
        Frequency of the largest error with the filter, rad/s.

    Raises
    ------
    ValueError
        For a filter that is not stable, an error or frequency that is negative or nan, or what `Law` refuses.
        That it has one input and one output is not checked.
    """

    kind = "reference filter"
    equations = "x+ = A x + B r; filtered reference = C x + D r"

    error_before: float
    error_after: float
    worst_rad_s: float

    def __post_init__(self) -> None:
        """Check stability and the reached errors (ValueError, see the class)."""
        super().__post_init__()
        if self.order and not np.max(np.abs(self.poles)) < 1:
            raise ValueError("the reference filter is not stable")
        for name in ("error_before", "error_after", "worst_rad_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"reference filter {name} must not be negative; got {getattr(self, name)}")

    def filtered(self, reference: Real) -> Real:
        """Reference (T,) behind the filter, from rest: what `closed_loop.simulate` takes. Raises ValueError
        for an array of another shape; a value that is nan stays in all that follow."""
        reference = np.asarray(reference, dtype=np.float64)
        if reference.ndim != 1:
            raise ValueError(f"reference must be (T,); got {reference.shape}")
        return _filtered(self, reference.tobytes())


@lru_cache(maxsize=8)
def _filtered(law: ReferenceFilter, reference: bytes) -> Real:
    """Filtered reference (T,) for the bytes of a reference (T,) of doubles. Kept, because trials of one loop
    have one reference, and stepping through it in Python takes longer than the loop: the 8 used last, of a
    few laws. Read-only, as all callers share it."""
    import control  # here, because it brings a plotting library with it

    outputs = control.forced_response(law.to_control(), inputs=np.frombuffer(reference)).outputs
    return np.asarray(readonly(outputs))


def worst_matching_error(k: Complex, follow: Complex, model: Complex, ellipses: Ellipses) -> Real:
    """Largest |F G k/(1 + G k) - T_ref| over G in each ellipse, (F,); inf where a member puts the loop on -1.

    k, follow, model : (F,) complex arrays
        Controller with its delay, reference filter F and model T_ref at the frequencies of the ellipses; of
        other shapes numpy's ValueError.

    The error is |(F - T_ref) k G - T_ref|/|1 + k G|, a `largest_ratio`.
    """
    return largest_ratio((follow - model) * k, -model, k, ellipses, accuracy=_ACCURACY)


def design_reference_filter(
    controller: Controller,
    plants: UncertainPlant | Sequence[UncertainPlant],
    model: RationalWeight,
    options: ReferenceFilterOptions | None = None,
    *,
    weight: RationalWeight | None = None,
) -> ReferenceFilter:
    """Reference filter with the smallest worst-case |W (F T - T_ref)| over all plants and their ellipses.

    Parameters
    ----------
    controller : Controller
        Of a loop that is robustly stable with every plant; its response with the computational delay counts.
    plants : UncertainPlant or sequence of them
        With the controller's sampling period.
    model : RationalWeight
        T_ref(s), at the Tustin frequency.
    options : ReferenceFilterOptions or None
        Order or poles of F, and grids. Poles that are not given are searched by a simplex from the model's
        corner.
    weight : RationalWeight or None
        W(s), at the Tustin frequency; None: 1.

    Returns
    -------
    ReferenceFilter
        With its certified error on the dense grid.

    Raises
    ------
    ValueError
        Without a plant, if an ellipse reaches -1, sampling times differ, a nominal loop is unstable, or a
        pole is not between 0 and Nyquist.
    """
    options = options or ReferenceFilterOptions()
    listed = (plants,) if isinstance(plants, UncertainPlant) else tuple(plants)
    if not listed:
        raise ValueError("no plant given: the reference filter needs at least one uncertain plant")
    return _Matching(controller, listed, model, weight, options).solve()


class _Matching:
    """Grids and loops of one reference filter design, and the programmes on them.

    `grids` holds the lean frequencies (G,) of every plant in rad/s, which grow by exchange, `dense` its
    ellipses on the frequencies of the check.
    """

    def __init__(
        self,
        controller: Controller,
        plants: tuple[UncertainPlant, ...],
        model: RationalWeight,
        weight: RationalWeight | None,
        options: ReferenceFilterOptions,
    ) -> None:
        """Grids of every plant; refuses loops that are not robustly stable (see
        `design_reference_filter`)."""
        self.controller = controller
        self.plants = plants
        self.options = options
        self.model = model
        self.weight = weight or constant_weight(1.0)
        self.dt_s = controller.dt_s
        self.grids: list[Real] = []
        self.dense: list[Ellipses] = []
        for plant in plants:
            self.grids.append(programme_grid(plant, plant.modes, options))
            # The check stands on frequencies of its own, not on the programme's.
            ellipses = plant.at(programme_grid(plant, plant.modes, options, dense=True))
            self.dense.append(ellipses)
            if not np.max(np.abs(closed_loop_poles(controller, plant)), initial=0.0) < 1:
                raise ValueError(
                    f"plant {plant.name!r}: the nominal loop is unstable; no reference filter helps"
                )
            gap = distance_to_minus_one(self.controller.response(ellipses.omega_rad_s), ellipses)
            if not np.all(gap > 0):
                raise ValueError(
                    f"plant {plant.name!r}: at {ellipses.omega_rad_s[np.argmin(gap)]:.4g} rad/s a member "
                    "of the ellipse puts the loop on -1; a reference filter needs a robustly stable loop"
                )

    def solve(self) -> ReferenceFilter:
        """The filter with the poles of the options, or searched ones; ValueError for stated poles outside of
        (0, Nyquist)."""
        poles = self._stated_poles()
        if poles is None:
            poles = self._searched_poles()
        error_before = max(float(np.max(errors)) for errors in self._errors(Poles(), np.ones(1)))
        best = exchanged(
            lambda _: self._coefficients(poles, self.grids, _BOUNDARY_SAMPLES),
            lambda x: self._errors(poles, self._full(poles, x)),
            self.grids,
            self._omegas,
            rounds=self.options.exchange_rounds,
            most=_MOST_ADDED,
        )
        # Denominators of this programme are constant, so there always is a point.
        assert best.x is not None
        coefficients = self._full(poles, best.x)
        errors = np.concatenate(best.values)
        worst_rad_s = float(np.concatenate(self._omegas)[np.argmax(errors)])
        a, b, _, _ = basis_state_space(poles)
        c = coefficients[None, 1:]
        d = np.array([[coefficients[0]]])
        return ReferenceFilter(a, b, c, d, self.dt_s, error_before, best.worst, worst_rad_s)

    def _stated_poles(self) -> Poles | None:
        """Poles in z that the options state: from decay rates in rad/s, none for order 0; None: to be
        searched. Raises ValueError for a rate outside of (0, Nyquist)."""
        rates = self.options.poles_rad_s
        if rates is None:
            return Poles() if self.options.order == 0 else None
        if not all(0 < rate < np.pi / self.dt_s for rate in rates):
            raise ValueError(
                f"poles_rad_s must lie between 0 and the Nyquist frequency {np.pi / self.dt_s:.4g}; "
                f"got {rates}"
            )
        return Poles(np.exp(-self.dt_s * np.array(rates)))

    def _searched_poles(self) -> Poles:
        """Real poles in z by a simplex over the logarithms of their decay rates, on thinned grids with half
        the samples; the best of three starts. At least one pole (`options.order`)."""
        import scipy.optimize  # here: it takes its time to load

        thin_grids = [grid[::_SEARCH_THINNING] for grid in self.grids]
        n_samples = _BOUNDARY_SAMPLES // 2
        n_poles = self.options.order
        nyquist = np.pi / self.dt_s
        low = np.log(_SLOWEST_SHARE * nyquist)
        high = np.log(_FASTEST_SHARE * nyquist)

        def poles_of(log_rates: Real) -> Poles:
            """Poles in z for logarithms of decay rates (N,), which are sorted and brought into their limits;
            nan stays."""
            rates = np.exp(np.clip(np.sort(log_rates), low, high))
            return Poles(np.exp(-self.dt_s * rates))

        def cost(log_rates: Real) -> float:
            """Smallest error with these poles, and how far rates lie outside of their limits."""
            excess = np.maximum(low - log_rates, 0) + np.maximum(log_rates - high, 0)
            outside = float(np.sum(excess))
            return self._coefficients(poles_of(log_rates), thin_grids, n_samples).gamma + outside

        # Corner of the model: where |T_ref| has fallen by 3 dB from its value at the lowest grid frequency,
        # or a tenth of the highest one where it falls nowhere, as a start has to be somewhere.
        omega = self.grids[0]
        size = np.abs(self._model_at(omega))
        fallen = np.flatnonzero(size < size[0] / np.sqrt(2))
        corner = float(omega[fallen[0]] if fallen.size else 0.1 * omega[-1])
        from_middle = np.arange(n_poles) - (n_poles - 1) / 2
        spread = np.log(corner) + np.log(_POLE_SPREAD) * from_middle
        answers = []
        for shift in np.log(_START_FACTORS):
            start = np.clip(spread + shift, low + _LOG_DISTANCE_FROM_ENDS, high - _LOG_DISTANCE_FROM_ENDS)
            answers.append(
                scipy.optimize.minimize(
                    cost,
                    start,
                    method="Nelder-Mead",
                    options={
                        "maxfev": _EVALUATIONS_PER_POLE * n_poles,
                        "xatol": _LOG_RATE_TOLERANCE,
                        "fatol": _ERROR_TOLERANCE,
                    },
                )
            )
        best = min(answers, key=lambda answer: float(answer.fun))
        return poles_of(best.x)

    def _model_at(self, omega: Real) -> Complex:
        """T_ref (F,) complex at omega (F,) in rad/s; infinite at a pole on the axis."""
        return self.model.at(imaginary_axis(omega, self.dt_s))

    def _weight_at(self, omega: Real) -> Complex:
        """W (F,) complex at omega (F,) in rad/s; infinite at a pole on the axis."""
        return self.weight.at(imaginary_axis(omega, self.dt_s))

    def _at_zero(self, poles: Poles) -> Real:
        """Values (1 + B,) of the constant and all basis functions at zero frequency, z = 1."""
        return np.asarray(np.real(with_constant(poles, np.zeros(1), self.dt_s)[0]))

    def _coefficients(self, poles: Poles, grids: Sequence[Real], samples: int) -> MinimaxPoint:
        """Free coefficients of F with the smallest largest error at samples of all ellipses.

        Parameters
        ----------
        poles : Poles
            Of F, with B basis functions L_i.
        grids : sequence of (G,) arrays
            Frequencies of every plant in rad/s.
        samples : int
            Points on the boundary of each ellipse, at equal steps of its angle.

        Returns
        -------
        MinimaxPoint
            Its gamma is the largest weighted error at the samples, finite as denominators are constant. With
            unit gain F = 1 + sum c_i (L_i - L_i(1)), x (B,); else F = c_0 + sum c_i L_i, x (1 + B,).
        """
        angle = 2 * np.pi * np.arange(samples) / samples
        parts = []
        bases = []
        n_frequencies = 0
        for plant, omega in zip(self.plants, grids, strict=True):
            ellipses = plant.at(omega)
            k = self.controller.response(omega)
            loop = ellipses.points(np.cos(angle)[:, None], np.sin(angle)[:, None]) * k
            tracking = loop / (1 + loop)
            weight = self._weight_at(omega)
            target = self._model_at(omega)
            basis = with_constant(poles, omega, self.dt_s)
            # Error without any coefficient: T - T_ref for unit gain, as F begins at 1, else -T_ref.
            offset = np.zeros_like(tracking)
            if self.options.unit_gain:
                offset = tracking
                basis = basis[:, 1:] - self._at_zero(poles)[1:]
            at = np.tile(np.arange(omega.size) + n_frequencies, samples)
            no_slope = np.zeros((at.size, 2))
            parts.append(
                PlaneRows(
                    at=at,
                    A=factor_matrices((weight * tracking).ravel()),
                    a=plane((weight * (offset - target)).ravel()),
                    e=np.ones(at.size),
                    E=no_slope,
                    C=np.zeros((at.size, 2, 2)),
                    c=no_slope,
                )
            )
            bases.append(basis)
            n_frequencies += omega.size
        rows = PlaneRows.stacked(parts)
        whole_basis = np.concatenate(bases)
        # Unit gain and no poles: F = 1, nothing to choose.
        if whole_basis.shape[1] == 0:
            errors = rows.numerator(np.zeros((whole_basis.shape[0], 2)))
            return MinimaxPoint(np.zeros(0), float(np.max(errors)))
        return smallest_ratio(whole_basis, rows)

    def _full(self, poles: Poles, x: Real) -> Real:
        """Coefficients (1 + B,) of the constant and all basis functions for free coefficients x (B,) with
        unit gain, where the constant is what makes F(1) = 1, else (1 + B,) as they are."""
        if not self.options.unit_gain:
            return x
        constant = 1.0 - float(x @ self._at_zero(poles)[1:])
        return np.concatenate([[constant], x])

    @property
    def _omegas(self) -> list[Real]:
        """Frequencies (F,) of every plant's dense grid in rad/s."""
        return [ellipses.omega_rad_s for ellipses in self.dense]

    def _errors(self, poles: Poles, coefficients: Real) -> list[Real]:
        """Exact weighted errors (F,) of F on every plant's dense grid, for coefficients (1 + B,)."""
        errors = []
        for omega, ellipses in zip(self._omegas, self.dense, strict=True):
            follow = with_constant(poles, omega, self.dt_s) @ coefficients
            k = self.controller.response(omega)
            error = worst_matching_error(k, follow, self._model_at(omega), ellipses)
            errors.append(np.abs(self._weight_at(omega)) * error)
        return errors
