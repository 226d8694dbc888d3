"""All controllers that stabilise one plant, and the poles to expand their free function in.

With coprime factors G = N/M and N X + M Y = 1, every stabilising controller is K = (X + M Q)/(Y - N Q) for a
stable Q (Youla, Jabr and Bongiorno, IEEE TAC 21, 1976), and K S and S are affine in Q (`AffineLoop`).
`coprime_factors` finds the factors of a plant that is not stable, `chosen_poles` a basis for Q that resolves
the plant's corners, modes and light zeros, and `with_constant` evaluates it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.linalg

from control_design.convex.convex_options import YoulaOptions
from control_design.plants.ellipses import Complex, Real
from control_design.plants.plant_set import UncertainPlant, matrix_response, modes_of
from ident.basis.functions import basis_response
from ident.basis.poles import Poles

if TYPE_CHECKING:
    import control

# Slowest mirrored pole as a share of the fastest real one: zeros of sampling lie as far from z = -1 as the
# plant turns in a sample, and farther. Chosen.
_SLOWEST_MIRRORED_SHARE = 3e-3

# Decay rate of the fastest real pole as a share of the Nyquist frequency: beyond it Q is constant for all
# that the requirements see. Chosen.
_FASTEST_SHARE = 0.95

# Decay rate of the slowest real pole as a share of the specification's frequency, for plants without a slower
# corner: the requirements have no slower corner of weight. Chosen.
_SLOWEST_SHARE = 0.02

# Poles of the plant slower than this share of the specification's frequency count as integrators, which are
# no corner that Q has to resolve. Chosen, three decades below what is asked.
_INTEGRATOR_SHARE = 1e-3

# A pole in z nearer to 0 than this is a delay: its decay rate would be infinite, and counts as 14/dt, beyond
# Nyquist.
_DEADBEAT_BELOW = 1e-6

# First damping ratio of the pairs at a mode over the mode's own: a little above it, as a basis pole on the
# mode itself adds nothing that the plant's factors do not have. Chosen.
_OWN_DAMPING_FACTOR = 1.3

# Smallest damping ratio that pairs begin at: less is narrower than the grid of frequencies resolves. Chosen.
_LEAST_DAMPING = 0.005

# Largest damping ratio that pairs begin at, so that a spread up to the last one is left. Chosen.
_MOST_OWN_DAMPING = 0.3

# Damping ratio of the last pair: without a resonance peak.
_LARGEST_DAMPING = 0.7

# Modes and zeros that get all pairs of the options each; more of them share the pairs of so many, as the time
# of a programme grows with the cube of the basis. Chosen.
_MODES_WITH_ALL_PAIRS = 3

# Pairs of a mode, at least: one a little above its own damping, one well damped.
_LEAST_PAIRS = 2

# Weight of the states beside the output in the linear-quadratic gains, relative to the output's: lets the
# Riccati equations have a solution where the output does not see a mode. The factors are not unique, so no
# bound moves.
_STATE_WEIGHT_SHARE = 1e-6


def with_constant(poles: Poles, omega_rad_s: Real, dt_s: float) -> Complex:
    """Values (F, 1 + B) complex at z = e^{j omega dt} of the constant one and of the B orthonormal basis
    functions with the given poles in z, each a column of a real pole, two of a pair; omega (F,) in rad/s, up
    to Nyquist. dt_s is that of the poles (not checked)."""
    z = np.exp(1j * np.asarray(omega_rad_s, dtype=np.float64) * dt_s)
    return np.hstack([np.ones((z.size, 1), np.complex128), basis_response(poles, z)])


def chosen_poles(plant: UncertainPlant, scale_rad_s: float, options: YoulaOptions) -> Poles:
    """Poles in z of the basis of Q for one plant.

    Parameters
    ----------
    plant : UncertainPlant
        Its poles, zeros, modes and sampling period.
    scale_rad_s : float
        Frequency of the specification, its bandwidth or the like; positive (not checked).
    options : YoulaOptions
        How many poles of each kind: `real_poles`, `mirrored_poles`, `pairs_per_mode`.

    Returns
    -------
    Poles
        Real ones spread logarithmically from the slowest corner of the plant to Nyquist; mirrored ones, at
        negative z next to Nyquist, where sampling puts zeros; and pairs at every mode and lightly damped
        zero, where Q inverts the plant, with damping ratios from their own to 0.7. More than three modes and
        zeros share the pairs of three (two each at least), so that the basis hardly grows with them. Modes at
        or above Nyquist are left out. All poles are stable.
    """
    dt = plant.dt_s
    decay_rates = np.abs(np.log(np.maximum(np.abs(plant.poles), _DEADBEAT_BELOW))) / dt
    is_no_integrator = decay_rates > _INTEGRATOR_SHARE * scale_rad_s
    slowest_of_plant = float(np.min(decay_rates[is_no_integrator], initial=np.inf))
    slowest = min(slowest_of_plant, _SLOWEST_SHARE * scale_rad_s)
    fastest = _FASTEST_SHARE * plant.nyquist_rad_s
    slowest_mirrored = _SLOWEST_MIRRORED_SHARE * fastest
    real = np.exp(-dt * np.geomspace(slowest, fastest, options.real_poles))
    mirrored = -np.exp(-dt * np.geomspace(slowest_mirrored, fastest, options.mirrored_poles))
    resonances = []
    for mode in [*plant.modes, *modes_of(plant.zeros, dt)]:
        if mode.omega_rad_s < plant.nyquist_rad_s:
            resonances.append(mode)
    shared_pairs = _MODES_WITH_ALL_PAIRS * options.pairs_per_mode // max(len(resonances), 1)
    n_pairs = max(_LEAST_PAIRS, min(options.pairs_per_mode, shared_pairs))
    pairs = [np.zeros(0, complex)]
    for mode in resonances:
        lowest_zeta = np.clip(_OWN_DAMPING_FACTOR * abs(mode.zeta), _LEAST_DAMPING, _MOST_OWN_DAMPING)
        zeta = np.geomspace(lowest_zeta, _LARGEST_DAMPING, n_pairs)
        pairs.append(np.exp(dt * mode.omega_rad_s * (-zeta + 1j * np.sqrt(1 - zeta**2))))
    return Poles(np.append(real, mirrored), np.concatenate(pairs))


@dataclass(frozen=True, eq=False)
class AffineLoop:
    """K S and S as they depend on the free function Q, at F frequencies; all fields (F,) complex.

    base : the plant's response, with the computational delay. K S = effort + effort_slope Q and
    S = sensitivity + sensitivity_slope Q, where K is the controller without that delay. Nothing is checked;
    at a pole of the plant on the circle base is infinite, the others are finite.
    """

    base: Complex
    effort: Complex
    effort_slope: Complex
    sensitivity: Complex
    sensitivity_slope: Complex


@dataclass(frozen=True, eq=False)
class Factors:
    """Coprime factors of a plant G = N/M with N X + M Y = 1: four stable discrete systems, one input and one
    output each. N and M share their states, X and Y theirs: `loop` relies on it, `coprime_factors` provides
    it; nothing is checked."""

    N: control.StateSpace
    M: control.StateSpace
    X: control.StateSpace
    Y: control.StateSpace

    def loop(self, omega_rad_s: Real) -> AffineLoop:
        """The loop K S = M (X + M Q), S = M (Y - N Q) at omega (F,) in rad/s, up to Nyquist. At a frequency
        where M vanishes, a plant's pole on the circle, base is infinite or nan."""
        # N and M differ in their outputs only: one system with two outputs is evaluated.
        outputs = np.vstack([self.N.C, self.M.C])
        output_feedthrough = np.vstack([self.N.D, self.M.D])
        import control  # here, because it brings a plotting library with it

        plant_factors = control.ss(self.N.A, self.N.B, outputs, output_feedthrough, self.N.dt)
        n, m = matrix_response(plant_factors, omega_rad_s)[:, :, 0].T
        # X and Y differ in their inputs only.
        inputs = np.hstack([self.X.B, self.Y.B])
        input_feedthrough = np.hstack([self.X.D, self.Y.D])
        controller_factors = control.ss(self.X.A, inputs, self.X.C, input_feedthrough, self.X.dt)
        x, y = matrix_response(controller_factors, omega_rad_s)[:, 0].T
        return AffineLoop(
            base=n / m,
            effort=m * x,
            effort_slope=m * m,
            sensitivity=m * y,
            sensitivity_slope=-m * n,
        )


def coprime_factors(plant: control.StateSpace) -> Factors:
    """Coprime factors of a discrete plant by state feedback F and observer gain L, both linear-quadratic.

    Parameters
    ----------
    plant : control.StateSpace
        One input and one output, n states, discrete; any poles.

    Returns
    -------
    Factors
        N, M, X and Y with n states each and the plant's sampling time.

    Raises
    ------
    ValueError
        If an unstable or marginal mode cannot be moved by the input or seen at the output.

    Notes
    -----
    M = 1 + F(zI - A_F)^-1 B, N = D + (C + D F)(zI - A_F)^-1 B, X = F(zI - A_L)^-1 L, Y = 1 - F(zI - A_L)^-1
    (B + L D), with A_F = A + B F and A_L = A + L C (Nett, Jacobson and Balas, IEEE TAC 29, 1984).
    """
    import control  # here, because it brings a plotting library with it

    a, b, c, d = (np.asarray(getattr(plant, name), dtype=np.float64) for name in "ABCD")
    state_weight = _STATE_WEIGHT_SHARE * np.eye(a.shape[0])
    output_weight = c.T @ c
    input_weight = b @ b.T
    control_weight = output_weight + state_weight * np.trace(output_weight)
    observer_weight = input_weight + state_weight * np.trace(input_weight)
    try:
        p = scipy.linalg.solve_discrete_are(a, b, control_weight, np.eye(1))
        q = scipy.linalg.solve_discrete_are(a.T, c.T, observer_weight, np.eye(1))
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ValueError("the plant has a mode on or outside the circle that no controller moves") from error
    feedback = -np.linalg.solve(1.0 + b.T @ p @ b, b.T @ p @ a)
    observer = -np.linalg.solve(1.0 + c @ q @ c.T, c @ q @ a.T).T
    a_feedback = a + b @ feedback
    a_observer = a + observer @ c
    unit = np.ones((1, 1))
    return Factors(
        N=control.ss(a_feedback, b, c + d @ feedback, d, plant.dt),
        M=control.ss(a_feedback, b, feedback, unit, plant.dt),
        X=control.ss(a_observer, observer, feedback, 0 * unit, plant.dt),
        Y=control.ss(a_observer, -(b + observer @ d), feedback, unit, plant.dt),
    )
