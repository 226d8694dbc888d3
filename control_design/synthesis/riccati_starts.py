"""Starts for several joints: central H-infinity controllers of the weighted plant, reduced.

d = (references, what the ball puts in) is carried to z = (weighted outputs, weighted actuators, what the ball
sees). One constant scaling stands for those of all frequencies, and one gain for requirements that count by
themselves: a start, no worst case. Central controller: Glover and Doyle, Systems & Control Letters 11 (1988).
Reduction: balanced, weighted as the error of K moves z (Enns, CDC 1984), Gramians by quadrature. All of it in
Tustin's s.
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

System = tuple[Real, Real, Real, Real]  # A, B, C, D, continuous
_CLOSE = 1.02  # of gamma, above the smallest
_GAMMA = 1e-2, 1e3  # where the smallest norm is looked for
_CHEAP = 0.03  # weight where none is asked, on an actuator over the plant's smallest gain at the scale
_NONE = 1e-9  # of the largest entry, below zero: a Riccati solution that is semidefinite but for rounding
_POINTS = 600  # of the quadrature


class WeightedPlant(NamedTuple):
    """x' = A x + B1 d + B2 u, z = C1 x + D11 d + D12 u, e = C2 x + D21 d + D22 u, to be closed by u = K e."""

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
    """Of a plant and its requirements, e = -y; scaling: of what the ball puts in, over the references.

    A strong weight on tracking replaces the constant one on the modulus. Poles lie slowest_rad_s further to
    the left than they do, so that none is on the axis. Neglected: a ball that is known on its own frequencies
    only, errors of channels.
    """
    A, B, C, D = continuous(plant.delayed(specification.computational_delay_samples))
    there = C @ np.linalg.solve(1j * scale_rad_s * np.eye(A.shape[0]) - A, B) + D
    asked = specification.weights(plant.inputs, plant.outputs)
    none = ("", (None,) * max(plant.inputs, plant.outputs))
    tracking, modulus, effort = (asked.get(name, none)[1] for name in ("tracking", "modulus", "effort"))
    of_y, of_u = (
        RationalWeight(numerator=(_CHEAP * size,), denominator=(1.0,))
        for size in (1.0, float(np.linalg.svd(there, compute_uv=False)[-1]))
    )
    on_y = [tracking[i] or modulus[i] or of_y for i in range(plant.outputs)]
    on_u = [effort[i] or of_u for i in range(plant.inputs)]
    put, wy, wu = np.eye(plant.outputs), _diagonal(on_y), _diagonal(on_u)
    if plant.ball is not None and plant.ball.omega_rad_s is None:
        size, (a, b, c, d) = plant.ball.radius / scaling, continuous(plant.ball.Li)
        put = np.hstack([put, scaling * plant.ball.Lo])
        wu = (
            scipy.linalg.block_diag(wu[0], a),
            np.vstack([wu[1], b]),
            scipy.linalg.block_diag(wu[2], size * c),
            np.vstack([wu[3], size * d]),
        )
    n, m, k = A.shape[0], wy[0].shape[0], wu[0].shape[0]
    zero = np.zeros
    all_a = np.block([[A, zero((n, m + k))], [wy[1] @ C, wy[0], zero((m, k))], [zero((k, n + m)), wu[0]]])
    return WeightedPlant(
        all_a - slowest_rad_s * np.eye(n + m + k),
        np.vstack([zero((n, put.shape[1])), wy[1] @ put, zero((k, put.shape[1]))]),
        np.vstack([B, wy[1] @ D, wu[1]]),
        np.block([[wy[3] @ C, wy[2], zero((wy[3].shape[0], k))], [zero((wu[3].shape[0], n + m)), wu[2]]]),
        np.hstack([-C, zero((plant.outputs, m + k))]),
        np.vstack([wy[3] @ put, zero((wu[3].shape[0], put.shape[1]))]),
        np.vstack([wy[3] @ D, wu[3]]),
        -put,
        -D,
    )


def central_controller(P: WeightedPlant) -> System | None:
    """K with a closed loop of nearly the smallest H-infinity norm, as many states as P; None where it has
    none that can be told from rounding."""
    low, high, found = *_GAMMA, None
    while high > _CLOSE * low:
        middle = float(np.sqrt(low * high))
        tried = _central(P, middle)
        low, high, found = (middle, high, found) if tried is None else (low, middle, tried)
    if found is None:
        return None
    A, B, C, D = found
    inverse = np.linalg.inv(np.eye(D.shape[0]) - D @ P.D22)  # e carries D22 u already
    C, D_e = inverse @ C, inverse @ D
    return A + B @ P.D22 @ C, B @ (np.eye(D.shape[1]) + P.D22 @ D_e), C, D_e


def _central(P: WeightedPlant, gamma: float) -> System | None:
    """The central controller for D22 = 0 with a closed-loop norm below gamma, None without one: theorem of
    Glover and Doyle, in coordinates with D12 = [0; I], D21 = [0 I]."""
    n_z, n_u, n_e, n_d = *P.D12.shape, *P.D21.shape
    q, r = np.linalg.qr(P.D12, mode="complete")
    p, t = np.linalg.qr(P.D21.T, mode="complete")
    turn_z, turn_d = np.roll(q, -n_u, axis=1), np.roll(p, -n_e, axis=1)
    of_u, of_e = np.linalg.inv(r[:n_u]), np.linalg.inv(t[:n_e].T)
    B = np.hstack([P.B1 @ turn_d, P.B2 @ of_u])
    C = np.vstack([turn_z.T @ P.C1, of_e @ P.C2])
    D = turn_z.T @ P.D11 @ turn_d
    i, j = n_z - n_u, n_d - n_e
    D11, D12, D21, D22 = D[:i, :j], D[:i, j:], D[i:, :j], D[i:, j:]
    if max(np.linalg.norm(D[:i], 2) if i else 0.0, np.linalg.norm(D[:, :j], 2) if j else 0.0) >= gamma:
        return None
    row = np.hstack([D, np.vstack([np.zeros((i, n_u)), np.eye(n_u)])])
    column = np.vstack([D, np.hstack([np.zeros((n_e, j)), np.eye(n_e)])])
    R, T = row.T @ row, column @ column.T
    R[:n_d, :n_d] -= gamma**2 * np.eye(n_d)
    T[:n_z, :n_z] -= gamma**2 * np.eye(n_z)
    C1, B1 = C[:n_z], B[:, :n_d]
    X = _stabilising(P.A, B, C1.T @ C1, R, C1.T @ row)
    Y = _stabilising(P.A.T, C.T, B1 @ B1.T, T, B1 @ column.T)
    if X is None or Y is None or np.max(np.abs(np.linalg.eigvals(X @ Y))) >= gamma**2:
        return None
    F = -np.linalg.solve(R, row.T @ C1 + B.T @ X)
    L = -np.linalg.solve(T, column @ B1.T + C @ Y).T
    left, right = (
        np.linalg.inv(gamma**2 * np.eye(size) - product)
        for size, product in ((i, D11 @ D11.T), (j, D11.T @ D11))
    )
    K11 = -D21 @ D11.T @ left @ D12 - D22
    K12 = np.linalg.cholesky(np.eye(n_u) - D21 @ right @ D21.T)
    K21 = np.linalg.cholesky(np.eye(n_e) - D12.T @ left @ D12).T
    Z = np.linalg.inv(np.eye(P.A.shape[0]) - Y @ X / gamma**2)
    B2 = Z @ (B[:, n_d:] + L[:, i:n_z]) @ K12
    C2 = -K21 @ (C[n_z:] + F[j:n_d])
    BK = -Z @ L[:, n_z:] + B2 @ np.linalg.solve(K12, K11)
    CK = F[n_d:] + K11 @ np.linalg.solve(K21, C2)
    return P.A + B @ F + BK @ np.linalg.solve(K21, C2), BK @ of_e, of_u @ CK, of_u @ K11 @ of_e


def _stabilising(A: Real, B: Real, Q: Real, R: Real, S: Real) -> Real | None:
    """Semidefinite X with A'X + XA - (XB + S) R^-1 (B'X + S') + Q = 0 and a stable loop, R indefinite; None
    without one. From the Hamiltonian's stable subspace: scipy's solver rejects X = 0."""
    n = A.shape[0]
    a = A - B @ np.linalg.solve(R, S.T)
    whole = np.block([[a, -B @ np.linalg.solve(R, B.T)], [-Q + S @ np.linalg.solve(R, S.T), -a.T]])
    _, basis, stable = scipy.linalg.schur(whole, sort="lhp")
    if stable != n or np.linalg.cond(basis[:n, :n]) > 1 / np.finfo(float).eps:
        return None
    X = np.linalg.solve(basis[:n, :n].T, basis[n:, :n].T)
    X = 0.5 * (X + X.T)
    return X if np.linalg.eigvalsh(X)[0] > -_NONE * (1.0 + np.max(np.abs(X))) else None


def reduced(K: System, P: WeightedPlant, order: int, low_rad_s: float, high_rad_s: float) -> System:
    """K truncated to so many states, balanced by how an error of K moves z of the closed loop, low to high.

    To first order dz = Tzu dK Ted d."""
    A, B, C, D = K
    omega = np.geomspace(low_rad_s, high_rad_s, _POINTS)
    width = np.gradient(omega)
    s = np.asarray(1j * omega, dtype=np.complex128)
    states = _resolvent(P.A, np.hstack([P.B1, P.B2]), s)
    n_d = P.B1.shape[1]
    to_e = P.C2 @ states + np.hstack([P.D21, P.D22])
    from_u = P.C1 @ states[:, :, n_d:] + P.D12
    own, observed = _resolvent(A, B, s), np.swapaxes(_resolvent(A.T, C.T, s), 1, 2)
    value = C @ own + D
    loop = np.linalg.inv(np.eye(D.shape[1]) - to_e[:, :, n_d:] @ value)
    into = own @ loop @ to_e[:, :, :n_d]
    out = from_u @ (np.eye(D.shape[0]) + value @ loop @ to_e[:, :, n_d:]) @ observed
    P_root = _root(np.einsum("f,fij->ij", width, (into @ conjugate(into)).real))
    Q_root = _root(np.einsum("f,fij->ij", width, (conjugate(out) @ out).real))
    left, sizes, right = np.linalg.svd(Q_root.T @ P_root)
    scale = np.sqrt(np.maximum(sizes[:order], np.finfo(float).tiny))
    T, inverse = P_root @ right[:order].T / scale, (Q_root @ left[:, :order] / scale).T
    return inverse @ A @ T, inverse @ B, C @ T, D


def continuous(system: control.StateSpace) -> System:
    """In Tustin's s, of a discrete system without a pole at z = -1."""
    A, B, C, D = (np.asarray(getattr(system, each), dtype=np.float64) for each in "ABCD")
    inverse, eye = np.linalg.inv(A + np.eye(A.shape[0])), np.eye(A.shape[0])
    root = 2.0 / np.sqrt(system.dt)
    return 2.0 / system.dt * (A - eye) @ inverse, root * inverse @ B, root * C @ inverse, D - C @ inverse @ B


def _resolvent(A: Real, B: Real, s: Complex) -> Complex:
    return np.asarray(np.linalg.solve(s[:, None, None] * np.eye(A.shape[0]) - A, B + 0j))


def _root(gramian: Real) -> Real:
    sizes, axes = np.linalg.eigh(gramian)
    return np.asarray(axes * np.sqrt(np.maximum(sizes, 0.0)))


def _diagonal(weights: Sequence[RationalWeight]) -> System:
    import control  # here, because it brings a plotting library with it

    parts = [control.ss(control.tf(list(w.numerator), list(w.denominator))) for w in weights]
    whole = control.append(*parts)
    return whole.A, whole.B, whole.C, whole.D
