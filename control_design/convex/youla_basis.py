"""All controllers that stabilise one plant: K = (X + M Q)/(Y - N Q), Q stable; poles to expand Q in."""

from __future__ import annotations

from dataclasses import dataclass

import control
import numpy as np
import scipy.linalg

from control_design.convex.convex_options import YoulaOptions
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant, matrix_response, modes_of
from ident.basis.functions import basis_response
from ident.basis.poles import Poles

_NEAREST = 3e-3  # of Nyquist: zeros of sampling lie as far as the plant turns in a sample, and farther


def with_constant(poles: Poles, omega_rad_s: Real, dt_s: float) -> Complex:
    """Constant and orthonormal functions with the given poles at z = e^{j omega dt}: (F, 1 + functions)."""
    z = np.exp(1j * np.asarray(omega_rad_s, dtype=np.float64) * dt_s)
    return np.hstack([np.ones((z.size, 1), np.complex128), basis_response(poles, z)])


def chosen_poles(plant: UncertainPlant, scale_rad_s: float, options: YoulaOptions) -> Poles:
    """Poles of the basis of Q: real ones spread logarithmically from the slowest corner of the plant to
    Nyquist; mirrored ones next to Nyquist, where sampling puts zeros; pairs at every mode and lightly damped
    zero (where Q inverts the plant), damping from their own to 0.7: as many as for three where there are
    more."""
    dt = plant.dt_s
    decay = np.abs(np.log(np.maximum(np.abs(plant.poles), 1e-6))) / dt
    lowest = min(float(np.min(decay[decay > 1e-3 * scale_rad_s], initial=np.inf)), 0.02 * scale_rad_s)
    fastest, pairs, found = 0.95 * plant.nyquist_rad_s, options.pairs_per_mode, []
    real = np.exp(-dt * np.geomspace(lowest, fastest, options.real_poles))
    mirrored = -np.exp(-dt * np.geomspace(_NEAREST * fastest, fastest, options.mirrored_poles))
    resonances = [*plant.modes, *modes_of(plant.zeros, dt)]
    resonances = [each for each in resonances if each.omega_rad_s < plant.nyquist_rad_s]
    count = max(2, min(pairs, 3 * pairs // max(len(resonances), 1)))
    for each in resonances:
        zeta = np.geomspace(np.clip(1.3 * abs(each.zeta), 0.005, 0.3), 0.7, count)
        found.append(np.exp(dt * each.omega_rad_s * (-zeta + 1j * np.sqrt(1 - zeta**2))))
    return Poles(np.append(real, mirrored), np.concatenate(found) if found else np.zeros(0, complex))


@dataclass(frozen=True, eq=False)
class AffineLoop:
    """K S and S as they depend on the free function Q at F frequencies, for the base plant G (F,):
    K S = effort + effort_slope Q, S = sensitivity + sensitivity_slope Q, all (F,), K without its delay."""

    base: Complex
    effort: Complex
    effort_slope: Complex
    sensitivity: Complex
    sensitivity_slope: Complex


@dataclass(frozen=True, eq=False)
class Factors:
    """Coprime factors of a plant: control systems with N X + M Y = 1, G = N/M, all stable."""

    N: control.StateSpace
    M: control.StateSpace
    X: control.StateSpace
    Y: control.StateSpace

    def loop(self, omega_rad_s: Real) -> AffineLoop:
        """K S = M (X + M Q), S = M (Y - N Q)."""
        # N and M share their states, X and Y theirs.
        above, below = self.N, self.M
        both = np.vstack([above.C, below.C]), np.vstack([above.D, below.D])
        n, m = matrix_response(control.ss(above.A, above.B, *both, above.dt), omega_rad_s)[:, :, 0].T
        one, other = self.X, self.Y
        inputs, direct = np.hstack([one.B, other.B]), np.hstack([one.D, other.D])
        x, y = matrix_response(control.ss(one.A, inputs, one.C, direct, one.dt), omega_rad_s)[:, 0].T
        return AffineLoop(n / m, m * x, m * m, m * y, -m * n)


def coprime_factors(plant: control.StateSpace) -> Factors:
    """Factors of a discrete SISO plant by state feedback F and observer gain L, both linear-quadratic.

    M = 1 + F(zI - A_F)^-1 B, N = D + (C + D F)(zI - A_F)^-1 B, X = F(zI - A_L)^-1 L, Y = 1 - F(zI - A_L)^-1
    (B + L D), with A_F = A + B F, A_L = A + L C. Raises ValueError if an unstable or marginal mode cannot be
    moved by the input or seen at the output.
    """
    a, b, c, d = (np.asarray(getattr(plant, name), dtype=np.float64) for name in "ABCD")
    n, dt = a.shape[0], plant.dt
    small = 1e-6 * np.eye(n)
    try:
        p = scipy.linalg.solve_discrete_are(a, b, c.T @ c + small * np.trace(c.T @ c), np.eye(1))
        q = scipy.linalg.solve_discrete_are(a.T, c.T, b @ b.T + small * np.trace(b @ b.T), np.eye(1))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError("the plant has a mode on or outside the circle that no controller moves") from error
    f = -np.linalg.solve(1.0 + b.T @ p @ b, b.T @ p @ a)
    gain = -np.linalg.solve(1.0 + c @ q @ c.T, c @ q @ a.T).T
    a_f, a_l, one = a + b @ f, a + gain @ c, np.ones((1, 1))
    return Factors(
        N=control.ss(a_f, b, c + d @ f, d, dt),
        M=control.ss(a_f, b, f, one, dt),
        X=control.ss(a_l, gain, f, 0 * one, dt),
        Y=control.ss(a_l, -(b + gain @ d), f, one, dt),
    )
