"""P2 of the identification benchmarks: a hub with three flexible modes (or five), simulated by SciPy alone.

G(s) = b/(s+b) [1/(s+a) + sum c_i w_i^2/(s^2 + 2 z_i w_i s + w_i^2)], zero-order hold at 5 ms; input random
+-1 held two samples with random phase, new for every run; noise scaled to 20 log10(rms of the noise-free
output / standard deviation of the noise).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import signal

from tests.ident.benchmark_plants import Truth, as_record, p2_system, run

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


def draw(setting: Setting, rng: np.random.Generator) -> Truth:
    """A run of this setting; everything random comes from rng."""
    modes = np.array(MODES[: setting.n_modes])
    hertz, zeta, gain = modes.T
    slow = 0.1
    fast = 25.0
    if setting.random_plant:
        hertz = np.concatenate([[rng.uniform(2, 3), rng.uniform(8, 15), rng.uniform(25, 30)], hertz[3:]])
        zeta = np.concatenate([rng.uniform(0.01, 0.02, 3), zeta[3:]])
        slow *= np.exp(rng.uniform(-0.5, 0.5))
        fast *= np.exp(rng.uniform(-0.3, 0.3))
        gain = gain * np.exp(np.concatenate([rng.uniform(-0.4, 0.4, 3), np.zeros(gain.size - 3)]))
    plant = p2_system(slow, fast, 2 * np.pi * hertz, zeta, gain)
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
