"""Intervals of an effect's parameters from the covariance of its search coordinates."""

from __future__ import annotations

import numpy as np

from diagnosis.machine.machine_protocol import Real
from plant.effects.search_space import Candidate


def parameter_intervals(
    candidate: Candidate, coordinates: Real, covariance: Real, rng: np.random.Generator, draws: int
) -> dict[str, tuple[float, float]]:
    """95 % intervals by Gaussian draws of the coordinates (A,), kept inside their box; covariance (A, A)."""
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    moved = coordinates + rng.standard_normal((draws, coordinates.size)) @ root.T
    sampled = [candidate.parameters(draw) for draw in np.clip(moved, *candidate.box)]
    found = {}
    for key, value in candidate.parameters(coordinates).items():
        spread = np.array([p[key] for p in sampled]) - value
        if key == "phase_rad":
            spread = np.mod(spread + np.pi, 2 * np.pi) - np.pi
        below, above = np.quantile(spread, [0.025, 0.975])
        found[key] = (float(value + below), float(value + above))
    return found
