"""Known truths for identification tests, built with scipy only: P1 and P2 of the benchmark description.

SNR = 20 log10(standard deviation of the noise-free output / standard deviation of the white output noise);
with that reading the Cramer-Rao bounds of P1 come out as the published 0.97 and 0.063.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.signal

from ident import Poles, Record

DT_S = 0.005


@dataclass(frozen=True, eq=False)
class Truth:
    """Discrete state space of the plant, and a noisy record of it."""

    system: tuple
    record: Record
    clean: np.ndarray
    noise_std: float

    def response(self, omega_rad_s):
        A, B, C, D = self.system
        eye = np.eye(A.shape[0])
        return np.array(
            [(C @ np.linalg.solve(np.exp(1j * w * DT_S) * eye - A, B) + D)[0, 0] for w in omega_rad_s]
        )


def run(system, u):
    """Output of a discrete state space from rest, sample by sample."""
    A, B, C, D = system
    x = np.zeros((A.shape[0], 1))
    y = np.empty(u.size)
    for k, value in enumerate(u):
        y[k] = (C @ x + D * value)[0, 0]
        x = A @ x + B * value
    return y


def as_record(u, y, name="test", dt_s=DT_S):
    return Record(u[:, None], y[:, None], dt_s, name=name)


def _truth(system, u, snr_db, rng, name):
    clean = run(system, u)
    noise_std = np.std(clean) / 10 ** (snr_db / 20)
    return Truth(system, as_record(u, clean + noise_std * rng.normal(size=u.size), name), clean, noise_std)


def max_length_sequence(seed, n_samples):
    state = np.random.default_rng(seed).integers(0, 2, 11)
    state[0] = 1
    return scipy.signal.max_len_seq(11, state=state, length=n_samples)[0] * 2.0 - 1


def p1(seed, n_samples=1000, snr_db=30):
    """One mode at 15 rad/s, zeta 0.015, double integrator, non-minimum-phase zero."""
    system = _p1_system([1, 0, 0])
    return _scaled_truth(system, max_length_sequence(1, n_samples), snr_db, seed, f"P1 {seed}")


def p1_friction(seed, n_samples=1000, snr_db=30):
    """P1 with s (s + 0.3) in place of the double integrator and the input held 4 samples."""
    u = np.repeat(max_length_sequence(1, -(-n_samples // 4)), 4)[:n_samples]
    return _scaled_truth(_p1_system([1, 0.3, 0]), u, snr_db, seed, f"P1 with friction {seed}")


def _p1_system(slow_poles):
    numerator = 15.0**2 * np.polymul([-1 / 10.8, 1], [1 / 10.5, 1])
    denominator = np.polymul(slow_poles, [1, 2 * 0.015 * 15.0, 15.0**2])
    return scipy.signal.cont2discrete(scipy.signal.tf2ss(numerator, denominator), DT_S)[:4]


def _scaled_truth(system, u, snr_db, seed, name):
    """The plant with its gain set so that the noise-free output has the standard deviation 0.1265."""
    A, B, C, D = system
    scale = 0.1265 / np.std(run(system, u))
    return _truth((A, B, scale * C, scale * D), u, snr_db, np.random.default_rng(seed), name)


def by_factors(decays, modes, integrators):
    """Denominator in s of 1/s^k, lags (rates) and modes (rad/s, damping), and its poles in z, zeros in place
    of the integrators as a `GobfModel` has them."""
    denominator = np.concatenate([[1.0], np.zeros(integrators)])
    for factor in (*([1, rate] for rate in decays), *([1, 2 * zeta * w, w**2] for w, zeta in modes)):
        denominator = np.polymul(denominator, factor)
    omega, zeta = np.reshape(modes, (-1, 2)).T
    poles = Poles.from_continuous(decay_per_s=decays, omega_rad_s=omega, zeta=zeta, dt_s=DT_S)
    return denominator, Poles(np.concatenate([np.zeros(integrators), poles.real]), poles.pairs)


P2_HZ = (2.5, 11.0, 27.0)
P2_ZETA = (0.015, 0.015, 0.02)


def p2_system(slow_per_s, fast_per_s, omega_rad_s, zeta, gain):
    """A, B, C, D of b/(s+b) [1/(s+a) + sum c_i w_i^2/(s^2 + 2 z_i w_i s + w_i^2)] after the hold, modes (M,);
    modal states, so that nothing is lost to companion forms."""
    blocks, drive, out = [np.array([[-slow_per_s]])], [1.0], [1.0]
    for w, z, c in zip(omega_rad_s, zeta, gain, strict=True):
        blocks.append(np.array([[0.0, w], [-w, -2 * z * w]]))
        drive += [0.0, w]
        out += [c, 0.0]
    n = len(drive)
    A = np.zeros((n + 1, n + 1))
    A[:n, :n] = scipy.linalg.block_diag(*blocks)
    A[:n, n] = drive
    A[n, n] = -fast_per_s
    B = fast_per_s * np.eye(n + 1)[:, n:]
    return scipy.signal.cont2discrete((A, B, np.append(out, 0.0)[None, :], np.zeros((1, 1))), DT_S)[:4]


def p2(seed, n_samples=2000, snr_db=35):
    """Three modes and two slow real poles, random binary input held two samples."""
    system = p2_system(0.1, 25.0, 2 * np.pi * np.array(P2_HZ), P2_ZETA, (-0.02, 0.0045, -0.0016))
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.integers(0, 2, n_samples) * 2.0 - 1, 2)[rng.integers(0, 2) :][:n_samples]
    return _truth(system, u, snr_db, rng, f"P2 {seed}")


# (natural frequency in rad/s, zeta) of the modes of P3.
P3_MODES = {
    3: ((12.0, 0.015), (45.0, 0.015), (110.0, 0.02)),
    5: ((9.0, 0.01), (33.0, 0.01), (80.0, 0.012), (160.0, 0.015), (260.0, 0.02)),
}


def p3(n_modes, seed, snr_db, n_samples=2000):
    """Three or five modes beside 1/(s^2 + 0.3 s), residues (-1)^i 1.2/i; output scaled to 0.1265."""
    blocks, B, C = [np.array([[0.0, 1.0], [0.0, -0.3]])], [0.0, 1.0], [1.0, 0.0]
    for i, (omega, zeta) in enumerate(P3_MODES[n_modes], start=1):
        blocks.append(np.array([[0.0, 1.0], [-(omega**2), -2 * zeta * omega]]))
        B += [0.0, 1.0]
        C += [(-1) ** i * 1.2 / i, 0.0]
    drive, out = np.array(B)[:, None], np.array(C)[None, :]
    continuous = (scipy.linalg.block_diag(*blocks), drive, out, np.zeros((1, 1)))
    system = scipy.signal.cont2discrete(continuous, DT_S)[:4]
    name = f"P3 {n_modes} modes {snr_db} dB {seed}"
    return _scaled_truth(system, max_length_sequence(1, n_samples), snr_db, seed, name)
