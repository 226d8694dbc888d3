"""P2 of the identification benchmarks: a hub with three flexible modes (or five), simulated by SciPy alone.

G(s) = b/(s+b) [1/(s+a) + sum c_i w_i^2/(s^2 + 2 z_i w_i s + w_i^2)], zero-order hold at 5 ms; input random
+-1 held two samples with random phase, new for every run; noise scaled to 20 log10(rms of the noise-free
output / standard deviation of the noise).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal
from scipy.linalg import block_diag

from tests.ident.benchmark_plants import DT_S, Truth, as_record, run

# Three modes, then the two of the variant with five: frequency [Hz], damping ratio, gain.
MODES = (
    (2.5, 0.015, -0.02),
    (11.0, 0.015, 0.0045),
    (27.0, 0.02, -0.0016),
    (48.0, 0.015, 0.0006),
    (75.0, 0.02, -0.0003),
)
# Samples run before the record where it does not start from rest: seven seconds, a slow pole's 70 %.
_BEFORE = 1400


@dataclass(frozen=True)
class Setting:
    """What is simulated: N, SNR, fixed or random plant, number of modes, start, colour of the noise."""

    n_samples: int = 2000
    snr_db: float = 35.0
    random_plant: bool = False
    n_modes: int = 3
    from_rest: bool = True
    noise_pole: float = 0.0


def system(slow_per_s: float, fast_per_s: float, omega_rad_s: np.ndarray, zeta: np.ndarray, gain: np.ndarray):
    """A, B, C, D after the hold, modes (M,); modal states, so that nothing is lost to companion forms."""
    blocks = [np.array([[-slow_per_s]])]
    drive, out = [1.0], [1.0]
    for w, z, c in zip(omega_rad_s, zeta, gain, strict=True):
        blocks.append(np.array([[0.0, w], [-w, -2 * z * w]]))
        drive += [0.0, w]
        out += [c, 0.0]
    n = len(drive)
    A = np.zeros((n + 1, n + 1))
    A[:n, :n] = block_diag(*blocks)
    A[:n, n] = drive
    A[n, n] = -fast_per_s
    B = fast_per_s * np.eye(n + 1)[:, n:]
    return signal.cont2discrete((A, B, np.append(out, 0.0)[None, :], np.zeros((1, 1))), DT_S)[:4]


def draw(setting: Setting, rng: np.random.Generator) -> Truth:
    """A run of this setting; everything random comes from rng."""
    modes = np.array(MODES[: setting.n_modes])
    hertz, zeta, gain = modes.T
    slow, fast = 0.1, 25.0
    if setting.random_plant:
        hertz = np.concatenate([[rng.uniform(2, 3), rng.uniform(8, 15), rng.uniform(25, 30)], hertz[3:]])
        zeta = np.concatenate([rng.uniform(0.01, 0.02, 3), zeta[3:]])
        slow *= np.exp(rng.uniform(-0.5, 0.5))
        fast *= np.exp(rng.uniform(-0.3, 0.3))
        gain = gain * np.exp(np.concatenate([rng.uniform(-0.4, 0.4, 3), np.zeros(gain.size - 3)]))
    plant = system(slow, fast, 2 * np.pi * hertz, zeta, gain)
    before = 0 if setting.from_rest else _BEFORE
    total = before + setting.n_samples
    u = np.repeat(rng.choice([-1.0, 1.0], total // 2 + 2), 2)[rng.integers(0, 2) :][:total]
    clean = run(plant, u)[before:]
    noise_std = float(np.sqrt(np.mean(clean**2)) * 10 ** (-setting.snr_db / 20))
    a = setting.noise_pole
    white = rng.standard_normal(setting.n_samples + 200)
    noise = signal.lfilter([np.sqrt(1 - a * a)], [1.0, -a], white)[200:]
    record = as_record(u[before:], clean + noise_std * noise, "P2")
    return Truth(plant, record, clean, noise_std)
