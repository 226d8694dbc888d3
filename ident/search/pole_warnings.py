"""Poles that a search left where they should not be."""

from __future__ import annotations

import numpy as np

from ident.basis.coordinates import ZETA_LIMIT
from ident.basis.poles import Poles
from ident.data.finding import Finding, FindingKind, finding
from ident.fit.refinement import Bounds


def pole_warnings(poles: Poles, fixed: Poles, bounds: Bounds, dt_s: float) -> list[Finding]:
    """One finding for each searched pole that ended at a bound."""
    found = [] if poles.order else [finding(FindingKind.NO_POLE)]
    close = 1 + 1e-6
    for a in poles.real[fixed.real.size :]:
        if 1 - a <= bounds.distance_min * close:
            found.append(finding(FindingKind.SLOW_BOUND, a=a))
        elif 1 - a >= bounds.distance_max / close:
            found.append(finding(FindingKind.FAST_BOUND, a=a))
    omegas, zetas = poles.omega_rad_s(dt_s), poles.zeta()
    for pole, omega, zeta in list(zip(poles.pairs, omegas, zetas, strict=True))[fixed.pairs.size :]:
        if zeta >= ZETA_LIMIT - 1e-6:
            found.append(finding(FindingKind.OVERDAMPED_PAIR, omega_rad_s=omega, zeta=zeta))
        elif zeta >= bounds.zeta_max / close or zeta <= bounds.zeta_min * close:
            found.append(finding(FindingKind.DAMPING_BOUND, omega_rad_s=omega, zeta=zeta))
        elif -np.log(abs(pole)) <= bounds.s_min * close:
            found.append(finding(FindingKind.NO_DECAY, omega_rad_s=omega))
        if not bounds.omega_min * close < omega * dt_s < bounds.omega_max / close:
            found.append(finding(FindingKind.FREQUENCY_BOUND, omega_rad_s=omega))
    return found
