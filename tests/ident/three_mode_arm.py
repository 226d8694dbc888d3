"""P2 of the identification benchmarks: a hub with three flexible modes, simulated by SciPy alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from ident.data.record import Record

DT = 0.005
OMEGA = np.geomspace(0.3, 300.0, 150)
BANDS = (
    (0.3, 1), (1, 5), (5, 13), (13, 19), (19, 55), (55, 85), (66, 72), (85, 150), (150, 190), (190, 300.1),
)  # fmt: skip


@dataclass(frozen=True)
class Arm:
    record: Record
    truth: np.ndarray  # (F,) response on OMEGA
    poles: np.ndarray  # the two real ones, then the three of the upper half plane, in z


def random_arm(rng, n_samples=2000, snr_db=35.0, noise_pole=0.0):
    """One random plant, one random binary input, one noise realisation."""
    w = 2 * np.pi * np.array([rng.uniform(2, 3), rng.uniform(8, 15), rng.uniform(25, 30)])
    zeta = rng.uniform(0.01, 0.02, 3)
    a, b = 0.1 * np.exp(rng.uniform(-0.5, 0.5)), 25 * np.exp(rng.uniform(-0.3, 0.3))
    c = np.array([-0.02, 0.0045, -0.0016]) * np.exp(rng.uniform(-0.4, 0.4, 3))
    numerator, denominator = np.ones(1), np.array([1.0, a])
    for wi, zi, ci in zip(w, zeta, c, strict=True):
        mode = np.array([1.0, 2 * zi * wi, wi**2])
        numerator = np.polyadd(np.polymul(numerator, mode), ci * wi**2 * denominator)
        denominator = np.polymul(denominator, mode)
    A, B, C, D, _ = signal.cont2discrete(signal.tf2ss(b * numerator, np.polymul(denominator, [1.0, b])), DT)
    u = np.repeat(rng.choice([-1.0, 1.0], n_samples // 2 + 2), 2)[rng.integers(0, 2) :][:n_samples]
    y = signal.dlsim((A, B, C, D, DT), u[:, None])[1][:, 0]
    noise = signal.lfilter(
        [np.sqrt(1 - noise_pole**2)], [1, -noise_pole], rng.standard_normal(n_samples + 200)
    )
    y = y + np.sqrt(np.mean(y**2)) * 10 ** (-snr_db / 20) * noise[200:]
    points = np.exp(1j * OMEGA * DT)
    eye = np.eye(A.shape[0])
    truth = np.array([(C @ np.linalg.solve(z * eye - A, B) + D)[0, 0] for z in points])
    poles = np.exp(DT * np.concatenate([[-a, -b], (-zeta + 1j * np.sqrt(1 - zeta**2)) * w]))
    record = Record("arm", u[:, None], y[:, None], DT, ("u",), ("y",))
    return Arm(record, truth, poles)


def per_band(hits):
    """(runs, F) booleans -> coverage per band."""
    return np.array([hits[:, (low <= OMEGA) & (high > OMEGA)].mean() for low, high in BANDS])
