"""The pole search of one input, its costs replaced by those of several inputs with shared poles.

Boxes, DIRECT, descents, rescans and the stepwise choice of the order are inherited
(`ident.search.pole_search`, `ident.search.order_selection`); only what looks at the data is here, in plain
array operations: a fit takes seconds where the compiled one for a single input takes a tenth of one.
"""

from __future__ import annotations

import numpy as np

from ident.basis.coordinates import SearchSpace
from ident.basis.functions import block_parameters, run_cascade_free
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import RealArray
from ident.fit.descent import GROWTH, blocked, chain_rule, clip_parameters, free_parameters
from ident.fit.kernels import _schur_drop
from ident.fit.miso_regression import MisoRegression, driven, linearisation, project
from ident.fit.refinement import FAR, NEAR, Bounds, Polished
from ident.search.candidate_cost import CandidateCost
from ident.search.order_selection import OrderSelection, Progress
from ident.search.pole_search import ROUGH, PoleSearch
from ident.search.search_trace import PolishedMinimum

# Below this fraction of |y|^2 the Gram matrix of the candidates knows nothing; descents see the true
# residual.
_FLOOR = 1e-13


class MisoCost(CandidateCost):
    """Joint residual sum of squares of all channels over the unit cube of a search space, other poles
    frozen."""

    def __init__(self, data: MisoRegression, space: SearchSpace, shared: Poles, local: Poles) -> None:
        self.space = space
        self.evaluations = 0
        self._together = None
        self._floor = _FLOOR * float(data.y @ data.y)
        self._data = data
        frozen = project(data, shared, local)
        self._frozen = np.vstack([frozen.shared_q, frozen.residual])
        self._local_q = frozen.local_q
        self._power = float(frozen.residual @ frozen.residual)
        self._drive = driven(block_parameters(shared), shared.real.size, data, data.input_rows)[1]

    def rss(self, units: RealArray) -> RealArray:
        """Residual sums of squares (E,) at points (E, D) of the unit cube."""
        self.evaluations += len(units)
        return np.array([self._one(unit) for unit in units])

    def _one(self, unit: RealArray) -> float:
        data, n_real = self._data, self.space.n_real
        blocks = self.space.blocks(unit)
        rows, _ = driven(blocks, n_real, data, self._drive)
        if data.structure.estimate_initial_state:
            rows = np.vstack([_free_rows(blocks, n_real, data), rows])
        gram, on_frozen = rows @ rows.T, rows @ self._frozen.T
        for here in map(data.segment, range(data.n_records)):
            on_local = rows[:, here] @ self._local_q[:, here].T
            gram -= on_local @ on_local.T
        gram -= on_frozen[:, :-1] @ on_frozen[:, :-1].T
        return self._power - float(_schur_drop(gram, np.ascontiguousarray(on_frozen[:, -1])))


def _free_rows(blocks: RealArray, n_real: int, data: MisoRegression) -> RealArray:
    """Free responses of a cascade, those of each record in rows of their own, (K B, N)."""
    order = 2 * blocks.shape[0] - n_real
    response = np.empty((order, data.longest))
    run_cascade_free(blocks, n_real, response, 0, data.longest)
    rows = np.zeros((data.n_records * order, data.n_samples))
    for i, here in enumerate(map(data.segment, range(data.n_records))):
        rows[i * order : (i + 1) * order, here] = response[:, : here.stop - here.start]
    return rows


class MisoSearch(PoleSearch):
    """`PoleSearch` on the joint cost of several inputs."""

    data: MisoRegression
    patience = 1  # descents take far longer than for one input

    def __init__(self, data: MisoRegression, options: IdentOptions) -> None:
        super().__init__(data, options)

    def candidate_cost(self, space: SearchSpace, shared: Poles, local: Poles) -> CandidateCost:
        return MisoCost(self.data, space, shared, local)

    def residual(self, poles: Poles) -> RealArray:
        return project(self.data, poles).residual

    def descend(self, poles: Poles, stage: str, tolerance: float = 1e-9) -> Polished:
        """Polish from the given poles (fixed ones first) and note the end in the trace."""
        n_fixed = self.fixed.real.size, self.fixed.pairs.size
        damping = FAR if tolerance >= ROUGH else NEAR
        end = polish(self.data, poles, self.bounds, n_fixed, tolerance=tolerance, damping=damping)
        self.evaluations += end.iterations + 1
        self.minima.append(PolishedMinimum(stage, end.poles, end.rss))
        return end


class MisoSelection(OrderSelection):
    """`OrderSelection` for several inputs: the criterion counts 1 + U numbers per pole."""

    search: MisoSearch

    def __init__(self, search: MisoSearch, progress: Progress) -> None:
        super().__init__(search, progress)


def polish(
    data: MisoRegression,
    poles: Poles,
    bounds: Bounds,
    n_fixed: tuple[int, int] = (0, 0),
    *,
    max_iterations: int = 60,
    tolerance: float = 1e-9,
    damping: float = NEAR,
) -> Polished:
    """Levenberg-Marquardt as in `ident.fit.descent.descend`; the first n_fixed real poles and pairs stay.

    Stops when the decrease that the linearisation still promises is below `tolerance` of J.
    """
    n_free_real = poles.real.size - n_fixed[0]
    x = clip_parameters(free_parameters(*poles.writable(), *n_fixed), n_free_real, bounds.array)
    poles = _with_parameters(poles, x, n_fixed)
    here = linearisation(data, poles)
    if x.size == 0:
        return Polished(poles, here.rss, 0, True)
    # Residuals at rounding level relative to the output: nothing left to gain.
    floor = 1e-26 * float(data.y @ data.y)
    growth = GROWTH
    for iteration in range(max_iterations):
        chain = chain_rule(*poles.writable(), *n_fixed)
        system, slope = chain.T @ here.normal @ chain, chain.T @ here.gradient
        free = np.flatnonzero(~blocked(x, slope, n_free_real, bounds.array))
        if here.rss <= floor or free.size == 0:
            return Polished(poles, here.rss, iteration, True)
        scale = np.sqrt(np.maximum(np.diag(system)[free], 1e-300))
        system, slope = system[np.ix_(free, free)] / np.outer(scale, scale), slope[free] / scale
        if float(_schur_drop(system.copy(), slope.copy())) <= tolerance * here.rss:
            return Polished(poles, here.rss, iteration, True)
        while True:
            step = np.linalg.solve(system + damping * np.eye(free.size), slope)
            trial_x = x.copy()
            trial_x[free] += step / scale
            trial_x = clip_parameters(trial_x, n_free_real, bounds.array)
            trial_poles = _with_parameters(poles, trial_x, n_fixed)
            trial = linearisation(data, trial_poles)
            promised = float(step @ (2 * slope - system @ step))
            ratio = (here.rss - trial.rss) / promised if promised > 0 else 0.0
            if ratio > 1e-4:
                break
            damping, growth = damping * growth, GROWTH * growth
            if damping > 1e12:
                # No step of any length gains: the linearisation's promise is rounding, or a bound's corner.
                return Polished(poles, here.rss, iteration, False)
        x, poles, here = trial_x, trial_poles, trial
        damping, growth = damping * max(1 / 5, 1 - (2 * ratio - 1) ** 3), GROWTH
    return Polished(poles, here.rss, max_iterations, False)


def _with_parameters(poles: Poles, x: RealArray, n_fixed: tuple[int, int]) -> Poles:
    """The poles with their free ones at the unknowns x (1 - a; s, f)."""
    n_free_real = poles.real.size - n_fixed[0]
    pairs = np.exp(-x[n_free_real::2] + 1j * x[n_free_real + 1 :: 2])
    return Poles(
        np.concatenate([poles.real[: n_fixed[0]], 1 - x[:n_free_real]]),
        np.concatenate([poles.pairs[: n_fixed[1]], pairs]),
    )
