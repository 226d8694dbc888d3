"""Starts for several joints: central H-infinity controllers of the weighted plant, reduced to a given order.

`weighted_plant` writes plant and requirements as one system from d = (references, what the ball puts in) to
z = (weighted outputs, weighted actuators, what the ball sees). `central_controller` finds a controller with
nearly the smallest H-infinity norm from d to z (Glover and Doyle, Systems & Control Letters 11, 1988),
which has as many states as the weighted plant. `reduced` truncates it to the order that is asked: balanced,
weighted as the error of K moves z (Enns, Conference on Decision and Control 1984), Gramians by quadrature.

One constant scaling stands for those of all frequencies, and one gain for requirements that count by
themselves: a start, no worst case. All systems are continuous in Tustin's s = (2/dt) (z - 1)/(z + 1), where
frequency responses are those of the discrete ones; `continuous` maps a discrete system there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import scipy.linalg

from control_design.plants.ellipses import Complex, Real
from control_design.plants.multivariable import MultivariablePlant
from control_design.plants.scaled_bound import conjugate
from control_design.plants.weights import RationalWeight
from control_design.specification.multivariable import MultivariableSpecification

if TYPE_CHECKING:
    import control

# Norm of the closed loop over the smallest one, at which the search for it ends. Nearer to the smallest,
# the controller has faster and faster poles. Chosen: a start need not be nearer.
_CLOSE = 1.02
# Lower end of the search for the smallest norm. Weights are about one where they matter, so norms are, too.
_LOWEST_GAMMA = 1e-2

# The upper end: a norm of a thousand is a specification that nothing meets, and no start.
_HIGHEST_GAMMA = 1e3
# Weight where none is asked: on an output, and on an actuator over the plant's smallest gain at the scale.
# The theorem needs every actuator in z; this one is too cheap to decide anything. Chosen.
_CHEAP = 0.03
# How far below zero, of the largest entry, an eigenvalue of a Riccati solution counts as zero: rounding.
_NEARLY_ZERO = 1e-9
# Frequencies of the quadrature of the Gramians, logarithmic: of seven decades, some eighty a decade, so that
# a resonance of damping ratio .05 has four of them in its width.
_QUADRATURE_POINTS = 600


class System(NamedTuple):
    """Continuous state space: x' = A x + B u, y = C x + D u; A (n, n), B (n, m), C (p, n), D (p, m); time in
    seconds.

    Shapes are not checked.
    """

    A: Real
    B: Real
    C: Real
    D: Real


class WeightedPlant(NamedTuple):
    """System from (d, u) to (z, e), to be closed by u = K e.

    x' = A x + B1 d + B2 u,   z = C1 x + D11 d + D12 u,   e = C2 x + D21 d + D22 u.

    A (n, n); d has n_d, u U, z n_z and e Y entries, and the matrices the shapes that follow. Not checked.
    """

    A: Real
    B1: Real
    B2: Real
    C1: Real
    C2: Real
    D11: Real
    D12: Real
    D21: Real
    D22: Real


def weighted_plant(
    plant: MultivariablePlant,
    specification: MultivariableSpecification,
    scaling: float,
    scale_rad_s: float,
    slowest_rad_s: float,
) -> WeightedPlant:
    """Weighted plant of an H-infinity problem that stands for the requirements, with e = -y.

    Parameters
    ----------
    plant : MultivariablePlant
        Nominal plant (Y outputs, U inputs) and its ball, whose `radius` scales what Lo puts in at the outputs
        for what Li sees of the actuators.
    specification : MultivariableSpecification
        Its weights of "tracking" and "modulus" on each output, of "effort" on each actuator. One on tracking
        replaces the constant one on the modulus.
    scaling : float
        Of what the ball puts in, over the references; positive (not checked).
    scale_rad_s : float
        Frequency around which the controller acts, where actuators without a weight get one.
    slowest_rad_s : float
        Poles lie this much, rad/s, further to the left than they do, so that none is on the axis.

    Returns
    -------
    WeightedPlant
        States: plant with its computational delay, weights on the outputs, weights on the actuators and the
        ball's own. z: outputs, actuators, what the ball sees.

    Raises
    ------
    numpy.linalg.LinAlgError
        The plant has a pole at z = -1, or one at s = j scale_rad_s.

    Notes
    -----
    Neglected: a ball that is known on its own frequencies only, and errors of channels.
    """
    A, B, C, D = continuous(plant.delayed(specification.computational_delay_samples))
    shifted = 1j * scale_rad_s * np.eye(A.shape[0]) - A
    states_at_scale = np.linalg.solve(shifted, B)
    gains_at_scale = np.linalg.svd(C @ states_at_scale + D, compute_uv=False)
    smallest_gain = float(gains_at_scale[-1])

    # One weight for every output and actuator.
    asked = specification.weights(plant.inputs, plant.outputs)
    not_asked = ("", (None,) * max(plant.inputs, plant.outputs))
    tracking = asked.get("tracking", not_asked)[1]
    modulus = asked.get("modulus", not_asked)[1]
    effort = asked.get("effort", not_asked)[1]
    cheap_on_y = RationalWeight(numerator=(_CHEAP * 1.0,), denominator=(1.0,))
    cheap_on_u = RationalWeight(numerator=(_CHEAP * smallest_gain,), denominator=(1.0,))
    on_y = _diagonal([tracking[i] or modulus[i] or cheap_on_y for i in range(plant.outputs)])
    on_u = _diagonal([effort[i] or cheap_on_u for i in range(plant.inputs)])

    # The ball enters at the outputs through Lo, and sees the actuators through Li.
    entering = np.eye(plant.outputs)
    if plant.ball is not None and plant.ball.omega_rad_s is None:
        size = plant.ball.radius / scaling
        a, b, c, d = continuous(plant.ball.Li)
        entering = np.hstack([entering, scaling * plant.ball.Lo])
        on_u = System(
            A=scipy.linalg.block_diag(on_u.A, a),
            B=np.vstack([on_u.B, b]),
            C=scipy.linalg.block_diag(on_u.C, size * c),
            D=np.vstack([on_u.D, size * d]),
        )

    # Plant, weights on outputs and weights on actuators as one system; zeros by their shapes.
    A_y, B_y, C_y, D_y = on_y
    A_u, B_u, C_u, D_u = on_u
    n = A.shape[0]
    m = A_y.shape[0]
    k = A_u.shape[0]
    n_d = entering.shape[1]
    z_y = C_y.shape[0]
    z_u = C_u.shape[0]
    zero = np.zeros
    plant_row = [A, zero((n, m + k))]
    y_row = [B_y @ C, A_y, zero((m, k))]
    u_row = [zero((k, n + m)), A_u]
    dynamics = np.block([plant_row, y_row, u_row])
    z_y_row = [D_y @ C, C_y, zero((z_y, k))]
    z_u_row = [zero((z_u, n + m)), C_u]
    to_e = [-C, zero((plant.outputs, m + k))]
    from_d = [zero((n, n_d)), B_y @ entering, zero((k, n_d))]
    d_to_z = [D_y @ entering, zero((z_u, n_d))]
    return WeightedPlant(
        A=dynamics - slowest_rad_s * np.eye(n + m + k),
        B1=np.vstack(from_d),
        B2=np.vstack([B, B_y @ D, B_u]),
        C1=np.block([z_y_row, z_u_row]),
        C2=np.hstack(to_e),
        D11=np.vstack(d_to_z),
        D12=np.vstack([D_y @ D, D_u]),
        D21=-entering,
        D22=-D,
    )


def central_controller(P: WeightedPlant) -> System | None:
    """Controller u = K e with a closed loop of nearly the smallest H-infinity norm.

    Parameters
    ----------
    P : WeightedPlant
        D12 of full column rank and D21 of full row rank, as `weighted_plant` builds them.

    Returns
    -------
    System or None
        As many states as P. None where no norm up to 1000 is reached, or none that can be told from rounding.

    Raises
    ------
    numpy.linalg.LinAlgError
        A matrix of the theorem is singular, by rounding or by a D12 or D21 without full rank.

    Notes
    -----
    Bisection of the norm on a logarithmic scale. Each trial neglects D22, which a loop around the controller
    that was found puts back.
    """
    low = _LOWEST_GAMMA
    high = _HIGHEST_GAMMA
    controller: System | None = None
    while high > _CLOSE * low:
        middle = float(np.sqrt(low * high))
        trial = controller_below(P, middle)
        if trial is None:
            low = middle
        else:
            high = middle
            controller = trial
    if controller is None:
        return None
    A, B, C, D = controller
    # e carries D22 u already.
    inverse = np.linalg.inv(np.eye(D.shape[0]) - D @ P.D22)
    C_e = inverse @ C
    D_e = inverse @ D
    A_e = A + B @ P.D22 @ C_e
    B_e = B @ (np.eye(D.shape[1]) + P.D22 @ D_e)
    return System(A_e, B_e, C_e, D_e)


def controller_below(P: WeightedPlant, gamma: float) -> System | None:
    """Central controller for D22 = 0 with a closed-loop norm below gamma.

    Parameters
    ----------
    P : WeightedPlant
        D12 of full column rank and D21 of full row rank; its D22 is not looked at.
    gamma : float
        Positive, in the unit of P's weights.

    Returns
    -------
    System or None
        None without one: a direct term, a Riccati equation or their coupling forbids it.

    Raises
    ------
    numpy.linalg.LinAlgError
        A matrix is singular, or the freedom that is left is not positive definite, by rounding.

    Notes
    -----
    The theorem of Glover and Doyle (1988), in coordinates with D12 = [0; I], D21 = [0 I]; the names of
    matrices are theirs. X and Y solve the Riccati equations of state feedback and of estimation, F and L are
    their gains, and the spectral radius of X Y has to stay below gamma^2.
    """
    n_z, n_u = P.D12.shape
    n_e, n_d = P.D21.shape
    # Rotations of z and d, and changes of u and e, to D12 = [0; I] and D21 = [0 I].
    q, r = np.linalg.qr(P.D12, mode="complete")
    turn_z = np.roll(q, -n_u, axis=1)
    of_u = np.linalg.inv(r[:n_u])
    p, t = np.linalg.qr(P.D21.T, mode="complete")
    turn_d = np.roll(p, -n_e, axis=1)
    of_e = np.linalg.inv(t[:n_e].T)
    B = np.hstack([P.B1 @ turn_d, P.B2 @ of_u])
    C = np.vstack([turn_z.T @ P.C1, of_e @ P.C2])
    D = turn_z.T @ P.D11 @ turn_d
    # Blocks of D: i rows of z that no u reaches, j columns of d that no e shows.
    i = n_z - n_u
    j = n_d - n_e
    D11 = D[:i, :j]
    D12 = D[:i, j:]
    D21 = D[i:, :j]
    D22 = D[i:, j:]

    # No controller lowers the direct term that it does not touch.
    unreached = np.linalg.norm(D[:i], 2) if i else 0.0
    unseen = np.linalg.norm(D[:, :j], 2) if j else 0.0
    if max(unreached, unseen) >= gamma:
        return None

    # Riccati equations of state feedback (R, X) and of estimation (T, Y).
    u_columns = np.vstack([np.zeros((i, n_u)), np.eye(n_u)])
    row = np.hstack([D, u_columns])
    e_rows = np.hstack([np.zeros((n_e, j)), np.eye(n_e)])
    column = np.vstack([D, e_rows])
    R = row.T @ row
    R[:n_d, :n_d] -= gamma**2 * np.eye(n_d)
    T = column @ column.T
    T[:n_z, :n_z] -= gamma**2 * np.eye(n_z)
    C1 = C[:n_z]
    B1 = B[:, :n_d]
    X = _stabilising(P.A, B, C1.T @ C1, R, C1.T @ row)
    Y = _stabilising(P.A.T, C.T, B1 @ B1.T, T, B1 @ column.T)
    if X is None or Y is None:
        return None
    coupling = np.max(np.abs(np.linalg.eigvals(X @ Y)))
    if coupling >= gamma**2:
        return None
    F = -np.linalg.solve(R, row.T @ C1 + B.T @ X)
    L = -np.linalg.solve(T, column @ B1.T + C @ Y).T

    # The central controller: its direct term K11, and square roots K12, K21 of what freedom is left.
    left = np.linalg.inv(gamma**2 * np.eye(i) - D11 @ D11.T)
    right = np.linalg.inv(gamma**2 * np.eye(j) - D11.T @ D11)
    K11 = -D21 @ D11.T @ left @ D12 - D22
    K12 = np.linalg.cholesky(np.eye(n_u) - D21 @ right @ D21.T)
    K21 = np.linalg.cholesky(np.eye(n_e) - D12.T @ left @ D12).T
    Z = np.linalg.inv(np.eye(P.A.shape[0]) - Y @ X / gamma**2)
    L_12 = L[:, i:n_z]
    L_2 = L[:, n_z:]
    F_12 = F[j:n_d]
    F_2 = F[n_d:]
    B2 = Z @ (B[:, n_d:] + L_12) @ K12
    C2 = -K21 @ (C[n_z:] + F_12)
    C2_over_K21 = np.linalg.solve(K21, C2)
    BK = -Z @ L_2 + B2 @ np.linalg.solve(K12, K11)
    CK = F_2 + K11 @ C2_over_K21
    AK = P.A + B @ F + BK @ C2_over_K21
    return System(AK, BK @ of_e, of_u @ CK, of_u @ K11 @ of_e)


def _stabilising(A: Real, B: Real, Q: Real, R: Real, S: Real) -> Real | None:
    """Semidefinite X (n, n) with A'X + XA - (XB + S) R^-1 (B'X + S') + Q = 0 and a stable loop; None without.

    A (n, n), B and S (n, m), Q (n, n), R (m, m) indefinite. From the stable subspace of the Hamiltonian
    matrix: scipy's solver rejects X = 0. Without means: an eigenvalue on the axis, a subspace without X, or
    an X below zero. Raises LinAlgError for a singular R.
    """
    n = A.shape[0]
    a = A - B @ np.linalg.solve(R, S.T)
    upper_right = -B @ np.linalg.solve(R, B.T)
    lower_left = -Q + S @ np.linalg.solve(R, S.T)
    hamiltonian = np.block([[a, upper_right], [lower_left, -a.T]])
    _, basis, stable = scipy.linalg.schur(hamiltonian, sort="lhp")
    upper = basis[:n, :n]
    if stable != n or np.linalg.cond(upper) > 1 / np.finfo(float).eps:
        return None
    unsymmetric = np.linalg.solve(upper.T, basis[n:, :n].T)
    X = 0.5 * (unsymmetric + unsymmetric.T)
    largest_entry = np.max(np.abs(X))
    smallest_eigenvalue = np.linalg.eigvalsh(X)[0]
    is_semidefinite = smallest_eigenvalue > -_NEARLY_ZERO * (1.0 + largest_entry)
    return X if is_semidefinite else None


def reduced(K: System, P: WeightedPlant, order: int, low_rad_s: float, high_rad_s: float) -> System:
    """Controller truncated to a number of states, balanced by how its error moves z of the closed loop.

    Parameters
    ----------
    K : System
        Stabilises P; at least `order` states, else the matrices do not fit (numpy's ValueError).
    P : WeightedPlant
        What the error of K moves, by z.
    order : int
        States that stay.
    low_rad_s, high_rad_s : float
        Between which the error counts, with equal weight per rad/s; 0 < low < high.

    Returns
    -------
    System
        Stability of the closed loop is not ensured.

    Raises
    ------
    numpy.linalg.LinAlgError
        A pole of P or K lies on the axis at a frequency of the quadrature.

    Notes
    -----
    To first order dz = Tzu dK Ted d: a state counts by how strongly d reaches it through Ted, and by how
    strongly it reaches z through Tzu. The two Gramians are made alike, and the smallest Hankel singular
    values dropped.
    """
    A, B, C, D = K
    omega = np.geomspace(low_rad_s, high_rad_s, _QUADRATURE_POINTS)
    width = np.gradient(omega)
    s = np.asarray(1j * omega, dtype=np.complex128)

    # Open-loop responses, frequency first: of P from (d, u) to e and from u to z, of K's states and of K.
    n_d = P.B1.shape[1]
    B_of_both = np.hstack([P.B1, P.B2])
    D_of_both = np.hstack([P.D21, P.D22])
    plant_states = _resolvent(P.A, B_of_both, s)
    to_e = P.C2 @ plant_states + D_of_both
    e_of_d = to_e[:, :, :n_d]
    e_of_u = to_e[:, :, n_d:]
    z_of_u = P.C1 @ plant_states[:, :, n_d:] + P.D12
    reached = _resolvent(A, B, s)
    observed = np.swapaxes(_resolvent(A.T, C.T, s), 1, 2)
    value = C @ reached + D

    # Closed: from d to the states, and from the states to z.
    loop = np.linalg.inv(np.eye(D.shape[1]) - e_of_u @ value)
    around_loop = np.eye(D.shape[0]) + value @ loop @ e_of_u
    states_of_d = reached @ loop @ e_of_d
    z_of_states = z_of_u @ around_loop @ observed
    reach_power = (states_of_d @ conjugate(states_of_d)).real
    view_power = (conjugate(z_of_states) @ z_of_states).real

    # Balanced truncation by the square-root method.
    reach_root = _root(np.einsum("f,fij->ij", width, reach_power))
    view_root = _root(np.einsum("f,fij->ij", width, view_power))
    left, sizes, right = np.linalg.svd(view_root.T @ reach_root)
    largest = np.maximum(sizes[:order], np.finfo(float).tiny)
    scale = np.sqrt(largest)
    to_all = reach_root @ right[:order].T / scale
    from_all = (view_root @ left[:, :order] / scale).T
    return System(A=from_all @ A @ to_all, B=from_all @ B, C=C @ to_all, D=D)


def continuous(system: control.StateSpace) -> System:
    """Continuous system in Tustin's s with the frequency response of a discrete one.

    Parameters
    ----------
    system : control.StateSpace
        Discrete, dt in seconds (not checked).

    Returns
    -------
    System
        s = (2/dt) (z - 1)/(z + 1).

    Raises
    ------
    numpy.linalg.LinAlgError
        A pole at z = -1, where s is infinite.
    """
    A = np.asarray(system.A, dtype=np.float64)
    B = np.asarray(system.B, dtype=np.float64)
    C = np.asarray(system.C, dtype=np.float64)
    D = np.asarray(system.D, dtype=np.float64)
    eye = np.eye(A.shape[0])
    inverse = np.linalg.inv(A + eye)
    # Balanced: the same factor on B and C.
    root = 2.0 / np.sqrt(system.dt)
    A_s = 2.0 / system.dt * (A - eye) @ inverse
    B_s = root * inverse @ B
    C_s = root * C @ inverse
    return System(A_s, B_s, C_s, D - C @ inverse @ B)


def _resolvent(A: Real, B: Real, s: Complex) -> Complex:
    """(s I - A)^-1 B (F, n, m) at s (F,), for A (n, n) and B (n, m); LinAlgError at an eigenvalue of A."""
    shifted = s[:, None, None] * np.eye(A.shape[0]) - A
    return np.asarray(np.linalg.solve(shifted, B + 0j))


def _root(gramian: Real) -> Real:
    """Square root R (n, n) with R R' = gramian (n, n), which is semidefinite but for rounding."""
    sizes, axes = np.linalg.eigh(gramian)
    return np.asarray(axes * np.sqrt(np.maximum(sizes, 0.0)))


def _diagonal(weights: Sequence[RationalWeight]) -> System:
    """Weights of one channel each, side by side: a system of as many inputs and outputs.

    At least one weight. Each is proper, which `RationalWeight` ensures; poles on the axis pass, and are moved
    by the caller.
    """
    import control  # here, because it brings a plotting library with it

    parts = []
    for weight in weights:
        transfer = control.tf(list(weight.numerator), list(weight.denominator))
        parts.append(control.ss(transfer))
    whole = control.append(*parts)
    return System(whole.A, whole.B, whole.C, whole.D)
