"""An arm with friction at another step of its logs, for thinned ones and back.

The arm is one in continuous time (`ident.friction.arm`): at another step its poles in z are powers, and its
response between the samples stays.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.plausible_modes import LARGEST_DAMPING
from ident.data.arrays import real_rows
from ident.friction.arm import SteppedArm
from ident.friction.gauss_newton import FrictionFit

# Samples of a period of the highest mode in the thinned logs: with 16 a turntable was explained by an error
# sum of .11 where all samples gave .017, and with 32 by a pair at 76 Hz that it has not, for the mean of a
# command moves the arm otherwise within a step (benchmarks/machines_with_truth). Doubled, fits at 4 kHz take
# twice as long.
_SAMPLES_A_PERIOD = 64
# Frequencies at which an arm is taken from one step to another: from where it is an integrator or a spring to
# near the Nyquist frequency of the longer step, as shares of that; sixty in a decade.
_FITTED_SHARES = (1e-4, 0.8)
# Their number. Chosen: many more than poles.
_N_FITTED = 240


def steps_for(fit: FrictionFit, options: IdentOptions, dt_s: float) -> int:
    """Samples of logs in one of those that the highest mode of a fit asks for.

    Parameters
    ----------
    fit : FrictionFit
        A simple one on these logs.
    options : IdentOptions
        Of the search.
    dt_s : float
        Step of the logs, s.

    Returns
    -------
    int
        1, the logs as they are, for an arm without a mode, and where poles are stated in z or lie outside the
        unit circle: they belong to the step of the logs.
    """
    poles = fit.model.poles
    is_mode = poles.zeta() < LARGEST_DAMPING
    if not np.any(is_mode) or options.fixed_poles or options.unstable_poles:
        return 1
    highest_Hz = float(np.max(poles.omega_rad_s(dt_s)[is_mode])) / (2 * np.pi)
    return max(1, int(1 / (_SAMPLES_A_PERIOD * highest_Hz * dt_s)))


def at_step(fit: FrictionFit, dt_s: float) -> FrictionFit:
    """A fit whose arm has each pole once, on logs with another step.

    Parameters
    ----------
    fit : FrictionFit
        Without dead time.
    dt_s : float
        The new step, s.

    Returns
    -------
    FrictionFit
        Of the same arm in continuous time, as near as the new basis has it below the Nyquist frequency of the
        longer step; lag and observer are those of as many seconds, the observer's gain is left open.
    """
    ratio = dt_s / fit.model.dt_s
    if ratio == 1:
        return fit
    structure = replace(fit.arm.structure, unstable=_power(fit.arm.structure.unstable, ratio))
    arm = SteppedArm.of(_power(fit.model.poles, ratio), structure, dt_s, doubled=False)
    # Both arms are sums of the same states in continuous time, but for those that are gone within a sample.
    omega = np.geomspace(*_FITTED_SHARES, _N_FITTED) * np.pi / max(dt_s, fit.model.dt_s)
    response = fit.arm.continuous_response(omega) @ fit.coefficients
    basis = arm.continuous_response(omega) / response[:, None]
    target = np.ones(omega.size, np.complex128)
    coefficients = np.asarray(np.linalg.lstsq(real_rows(basis), real_rows(target), rcond=None)[0])
    model = replace(
        fit.model, poles=arm.poles, coefficients=coefficients, dt_s=dt_s, unstable=structure.unstable
    )
    return replace(
        fit,
        model=model,
        arm=arm,
        coefficients=coefficients,
        lag=fit.lag / ratio,
        correction=None,
        ratio=0.0,
    )


def _power(poles: Poles, power: float) -> Poles:
    """Poles in z after a step so many times as long; a delay, which has no power, stays one."""
    real = np.where(poles.real > 0, np.abs(poles.real) ** power, poles.real)
    pairs = np.exp(power * np.log(poles.pairs))
    return Poles(real, pairs.real + 1j * np.abs(pairs.imag))
