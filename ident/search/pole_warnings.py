"""Advice on poles that a search left where they should not be."""

from __future__ import annotations

import numpy as np

from ident.basis.coordinates import ZETA_LIMIT
from ident.basis.poles import Poles
from ident.fit.refinement import Bounds


def pole_warnings(poles: Poles, fixed: Poles, bounds: Bounds, dt_s: float) -> list[str]:
    """One sentence of advice for each searched pole that ended at a bound."""
    sentences = []
    if poles.order == 0:
        sentences.append(
            "no pole was worth keeping: the output shows no dynamics driven by this input; check the "
            "columns, the "
            "delay and the amplitude of the input"
        )
    close = 1 + 1e-6
    for a in poles.real[fixed.real.size :]:
        if 1 - a <= bounds.distance_min * close:
            sentences.append(
                f"a real pole went to the slow bound (a = {a:.9g}): it is an integrator as far as the "
                "record can "
                "tell; try integrators = 1 more and compare, or take the trend off an output that only drifts"
            )
        elif 1 - a >= bounds.distance_max / close:
            sentences.append(
                f"a real pole went to the fast bound (a = {a:.3g}): it stands for a direct term or a "
                "delay; try "
                "feedthrough = true, another input_delay_samples, or one real pole less"
            )
    omegas, zetas = poles.omega_rad_s(dt_s), poles.zeta()
    for pole, omega, zeta in list(zip(poles.pairs, omegas, zetas, strict=True))[fixed.pairs.size :]:
        if zeta >= ZETA_LIMIT - 1e-6:
            sentences.append(
                f"a pole pair at {omega:.4g} rad/s is overdamped (zeta = {zeta:.2f}): replace the pair "
                "by two real poles"
            )
        elif zeta >= bounds.zeta_max / close or zeta <= bounds.zeta_min * close:
            sentences.append(
                f"the pole pair at {omega:.4g} rad/s sits on its bound of zeta ({zeta:.4g}): it may "
                "describe a "
                "disturbance; fit one pair less, or widen zeta_min or zeta_max if you trust it"
            )
        elif -np.log(abs(pole)) <= bounds.s_min * close:
            sentences.append(
                f"the pole pair at {omega:.4g} rad/s does not decay within the record: its damping "
                "cannot be told; "
                "record longer"
            )
        if not bounds.omega_min * close < omega * dt_s < bounds.omega_max / close:
            sentences.append(
                f"a pole pair went to the bound of its frequency ({omega:.4g} rad/s): widen the bound, "
                "or fit one "
                "pair less"
            )
    return sentences
