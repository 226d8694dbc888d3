"""Sizes on which the cost does not depend smoothly (backlash, rounding): grids, all else following."""

from __future__ import annotations

import numpy as np

from diagnosis.fit.fit import Fit, fit
from diagnosis.fit.nominal import prior_cost, prior_curvature, prior_slope
from diagnosis.fit.residual import ResidualModel

_REACHES = (0.12, 0.04, 0.012)
_POINTS = 15


def refined(model: ResidualModel, end: Fit) -> Fit:
    """The fit with the sizes of its non-smooth effects sought on grids around where a descent has left them.

    Difference quotients along a non-smooth size say little, and a descent ends in the nearest jump. Each grid
    is evaluated with everything else moved along the Jacobian of the present point; the best point is refined
    without moving the size.
    """
    best = end
    for k, candidate in enumerate(end.candidates):
        if candidate.dependence != "non-smooth":
            continue
        for reach in _REACHES:
            best = _round(model, best, k, reach)
    return best


def _round(model: ResidualModel, best: Fit, k: int, reach: float) -> Fit:
    P = best.deviations.size
    sizes = [len(c.axes) for c in best.candidates]
    at = P + sum(sizes[:k])
    others = np.delete(np.arange(best.jacobian.shape[1]), at)
    J = best.jacobian[:, others]
    H = J.T @ J
    H[range(P), range(P)] += prior_curvature(best.deviations)
    scale = np.sqrt(np.maximum(np.diag(H), 1e-12))
    low, high = best.candidates[k].box
    trials = []
    for shift in np.linspace(-reach, reach, _POINTS):
        x = [part.copy() for part in best.coordinates]
        x[k][0] = np.clip(x[k][0] + shift, low[0], high[0])
        effects = tuple(c.effect_at(part) for c, part in zip(best.candidates, x, strict=True))
        e = model.of(best.deviations, effects)
        gradient = J.T @ e
        gradient[:P] += prior_slope(best.deviations)
        step = -np.linalg.solve(H + 1e-6 * np.diag(scale**2), gradient)
        cost = float(e @ e + gradient @ step) + prior_cost(best.deviations)
        trials.append((cost, x, best.deviations + np.clip(step[:P], -1.5, 1.5)))
    cost, x, d = min(trials, key=lambda trial: trial[0])
    if not cost < best.cost:
        return best
    found = fit(model, best.candidates, x, model.nominal.within(d), iterations=5, tolerance=0.5)
    return found if found.cost < best.cost else best
