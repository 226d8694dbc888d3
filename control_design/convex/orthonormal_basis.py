"""Orthonormal functions with chosen poles: frequency response, and a lossless cascade of small blocks."""

from __future__ import annotations

import numpy as np

from control_design.plants.ellipses import Complex, Real


def basis_response(poles_z: Complex, omega_rad_s: Real, dt_s: float) -> Complex:
    """Constant and orthonormal functions with the given poles at z = e^{j omega dt}: (F, 1 + functions).

    poles_z: real poles, and of each pair the one above the real axis; inside the circle, any order, repeated
    or not. Functions m: sqrt(1 - a^2)/(z - a) times the all-pass of the poles before it; a pair gives two
    (Kautz): sqrt(1 - g^2)(z - b)/D and sqrt((1 - g^2)(1 - b^2))/D, g = |p|^2, b = 2 Re p/(1 + g).
    """
    z = np.exp(1j * np.asarray(omega_rad_s, dtype=np.float64) * dt_s)
    columns = [np.ones_like(z)]
    passed = np.ones_like(z)
    for pole in np.asarray(poles_z, dtype=np.complex128):
        if pole.imag == 0:
            columns.append(passed * np.sqrt(1 - pole.real**2) / (z - pole.real))
            passed = passed * (1 - pole.real * z) / (z - pole.real)
            continue
        gamma = abs(pole) ** 2
        beta = 2 * pole.real / (1 + gamma)
        below = (z - pole) * (z - pole.conjugate())
        columns.append(passed * np.sqrt(1 - gamma**2) * (z - beta) / below)
        columns.append(passed * np.sqrt((1 - gamma**2) * (1 - beta**2)) / below)
        passed = passed * (1 - pole * z) * (1 - pole.conjugate() * z) / below
    return np.stack(columns, axis=1)


def basis_state_space(poles_z: Complex) -> tuple[Real, Real]:
    """A (n, n), B (n, 1) whose states are the functions of `basis_response` without the constant.

    Every block is all-pass and drives the next one, so A A^T + B B^T = I.
    """
    a = np.zeros((0, 0))
    b = np.zeros((0, 1))
    c, d = np.zeros((1, 0)), np.ones((1, 1))
    for pole in np.asarray(poles_z, dtype=np.complex128):
        if pole.imag == 0:
            real = pole.real
            root = np.sqrt(1 - real**2)
            block = np.array([[real]]), np.array([[root]]), np.array([[root]]), np.array([[-real]])
        else:
            g = abs(pole) ** 2
            beta = 2 * pole.real / (1 + g)
            sg, sb = np.sqrt(1 - g**2), np.sqrt(1 - beta**2)
            block = (
                np.array([[g * beta, -g * sb], [sb, beta]]),
                np.array([[sg], [0.0]]),
                np.array([[-beta * sg, sb * sg]]),
                np.array([[g]]),
            )
        a = np.block([[a, np.zeros((a.shape[0], block[0].shape[0]))], [block[1] @ c, block[0]]])
        b = np.vstack([b, block[1] @ d])
        c, d = np.hstack([block[3] @ c, block[2]]), block[3] @ d
    return a, b
