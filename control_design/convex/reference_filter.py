"""Second degree of freedom: u = K (F r - y), F chosen so that every member of the ellipses follows a model.

The error of a member G is W (F T - T_ref), T = G K/(1 + G K), affine in F: with chosen poles a convex minimax
over boundary samples of the ellipses, where the worst member lies (T is free of poles by robust stability).
The certified error is exact at every frequency of a dense grid: |a G + b| <= h |1 + k G| is a disc or the
outside of one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import control
import numpy as np
import scipy.optimize

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

_BOUNDARY_SAMPLES = 24  # of every ellipse
_ACCURACY = 1e-7  # of the certified errors, which are rounded up


@dataclass(frozen=True, eq=False)
class ReferenceFilter(Law):
    """r_filtered = F r: x+ = A x + B r, C x + D r, SISO and stable. error_before, error_after: largest
    weighted model-matching error over all plants and ellipses with F = 1 and with F, on the dense grid;
    worst_rad_s: where."""

    kind = "reference filter"
    equations = "x+ = A x + B r; filtered reference = C x + D r"

    error_before: float
    error_after: float
    worst_rad_s: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.order and not np.max(np.abs(self.poles)) < 1:
            raise ValueError("the reference filter is not stable")
        for name in ("error_before", "error_after", "worst_rad_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"reference filter {name} must not be negative; got {getattr(self, name)}")

    def filtered(self, reference: Real) -> Real:
        """The reference (T,) behind the filter, from rest: what `closed_loop.simulate` takes."""
        reference = np.asarray(reference, dtype=np.float64)
        if reference.ndim != 1:
            raise ValueError(f"reference must be (T,); got {reference.shape}")
        return _filtered(self, reference.tobytes())


@lru_cache(maxsize=8)
def _filtered(law: ReferenceFilter, reference: bytes) -> Real:
    # Trials of one loop have one reference; stepping through it in Python takes longer than the loop.
    outputs = control.forced_response(law.to_control(), inputs=np.frombuffer(reference)).outputs
    return np.asarray(readonly(outputs))


def worst_matching_error(k: Complex, follow: Complex, model: Complex, ellipses: Ellipses) -> Real:
    """max over G in E of |F G k/(1 + G k) - T_ref| at every frequency, (F,); inf where a member puts the loop
    on -1. Controller k, follow F, model T_ref: (F,). The error is |(F - T_ref) k G - T_ref|/|1 + k G|."""
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

    model: T_ref(s), weight: W(s) or None for 1, both at the Tustin frequency. Poles that are not given are
    searched by a simplex from the model's corner. Raises ValueError if an ellipse reaches -1, sampling times
    differ, or a pole is not in (0, Nyquist).
    """
    options = options or ReferenceFilterOptions()
    listed = (plants,) if isinstance(plants, UncertainPlant) else tuple(plants)
    if not listed:
        raise ValueError("no plant given: the reference filter needs at least one uncertain plant")
    return _Matching(controller, listed, model, weight, options).solve()


class _Matching:
    """Grids and loops of one reference filter design."""

    def __init__(
        self,
        controller: Controller,
        plants: tuple[UncertainPlant, ...],
        model: RationalWeight,
        weight: RationalWeight | None,
        options: ReferenceFilterOptions,
    ) -> None:
        self.controller, self.plants, self.options = controller, plants, options
        self.model, self.weight, self.dt_s = model, weight or constant_weight(1.0), controller.dt_s
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
        poles = self._given_poles()
        if poles is None:
            poles = self._searched_poles()
        before = max(float(np.max(each)) for each in self._errors(Poles(), np.ones(1)))
        best = exchanged(
            lambda _: self._coefficients(poles, self.grids, _BOUNDARY_SAMPLES),
            lambda x: self._errors(poles, self._full(poles, x)),
            self.grids,
            self._omegas,
            rounds=self.options.exchange_rounds,
            most=12,
        )
        assert best.x is not None
        full, errors = self._full(poles, best.x), np.concatenate(best.values)
        where = float(np.concatenate(self._omegas)[np.argmax(errors)])
        a, b, _, _ = basis_state_space(poles)
        d = np.array([[full[0]]])
        return ReferenceFilter(a, b, full[None, 1:], d, self.dt_s, before, best.worst, where)

    def _given_poles(self) -> Poles | None:
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
        """Simplex search of the logarithmic decay rates on thinned grids, half the samples."""
        thin = [grid[::3] for grid in self.grids]
        samples = _BOUNDARY_SAMPLES // 2
        nyquist = np.pi / self.dt_s
        low, high = np.log(1e-5 * nyquist), np.log(0.95 * nyquist)

        def cost(logs: Real) -> float:
            outside = float(np.sum(np.maximum(low - logs, 0) + np.maximum(logs - high, 0)))
            poles = Poles(np.exp(-self.dt_s * np.exp(np.clip(np.sort(logs), low, high))))
            return self._coefficients(poles, thin, samples).gamma + outside

        # Where |T_ref| has fallen by 3 dB from its value at the lowest grid frequency.
        omega = self.grids[0]
        size = np.abs(self._model_at(omega))
        below = np.flatnonzero(size < size[0] / np.sqrt(2))
        corner = float(omega[below[0]] if below.size else 0.1 * omega[-1])
        spread = np.log(corner) + np.log(4.0) * (np.arange(self.options.order) - (self.options.order - 1) / 2)
        answers = [
            scipy.optimize.minimize(
                cost,
                np.clip(spread + shift, low + 0.1, high - 0.1),
                method="Nelder-Mead",
                options={"maxfev": 30 * self.options.order, "xatol": 1e-2, "fatol": 1e-4},
            )
            for shift in np.log([0.3, 1.0, 4.0])
        ]
        best = min(answers, key=lambda answer: float(answer.fun))
        return Poles(np.exp(-self.dt_s * np.exp(np.clip(np.sort(best.x), low, high))))

    def _model_at(self, omega: Real) -> Complex:
        return self.model.at(imaginary_axis(omega, self.dt_s))

    def _weight_at(self, omega: Real) -> Complex:
        return self.weight.at(imaginary_axis(omega, self.dt_s))

    def _at_zero(self, poles: Poles) -> Real:
        """Values of all basis functions at z = 1."""
        return np.asarray(np.real(with_constant(poles, np.zeros(1), self.dt_s)[0]))

    def _coefficients(self, poles: Poles, grids: Sequence[Real], samples: int) -> MinimaxPoint:
        """Best free coefficients; with unit gain F = 1 + sum c_i (L_i - L_i(1)), else all of them."""
        angle = 2 * np.pi * np.arange(samples) / samples
        parts, bases, count = [], [], 0
        for plant, omega in zip(self.plants, grids, strict=True):
            ellipses = plant.at(omega)
            k = self.controller.response(omega)
            loop = ellipses.points(np.cos(angle)[:, None], np.sin(angle)[:, None]) * k
            tracking = loop / (1 + loop)
            w, target = self._weight_at(omega), self._model_at(omega)
            basis = with_constant(poles, omega, self.dt_s)
            offset = np.zeros_like(tracking)
            if self.options.unit_gain:
                offset, basis = tracking, basis[:, 1:] - self._at_zero(poles)[1:]
            at = np.tile(np.arange(omega.size) + count, samples)
            size, zero = at.size, np.zeros((at.size, 2))
            parts.append(
                PlaneRows(
                    at,
                    factor_matrices((w * tracking).ravel()),
                    plane((w * (offset - target)).ravel()),
                    np.ones(size),
                    zero,
                    np.zeros((size, 2, 2)),
                    zero,
                )
            )
            bases.append(basis)
            count += omega.size
        rows = PlaneRows.stacked(parts)
        whole = np.concatenate(bases)
        if whole.shape[1] == 0:
            return MinimaxPoint(np.zeros(0), float(np.max(rows.numerator(np.zeros((whole.shape[0], 2))))))
        return smallest_ratio(whole, rows)

    def _full(self, poles: Poles, x: Real) -> Real:
        """Coefficients of the constant and all functions."""
        if not self.options.unit_gain:
            return x
        return np.concatenate([[1.0 - float(x @ self._at_zero(poles)[1:])], x])

    @property
    def _omegas(self) -> list[Real]:
        return [ellipses.omega_rad_s for ellipses in self.dense]

    def _errors(self, poles: Poles, full: Real) -> list[Real]:
        """Exact weighted errors of F on the dense grids."""
        return [
            np.abs(self._weight_at(omega))
            * worst_matching_error(
                self.controller.response(omega),
                with_constant(poles, omega, self.dt_s) @ full,
                self._model_at(omega),
                e,
            )
            for omega, e in zip(self._omegas, self.dense, strict=True)
        ]
