"""Random plants of P2 with three modes, on the grid and in the bands of the benchmark of coverage."""

from dataclasses import dataclass

import numpy as np

from benchmarks.coverage_p2 import BANDS, OMEGA
from benchmarks.p2_plants import Setting, draw
from ident import GobfModel, Poles, Record
from tests.ident.benchmark_plants import DT_S


@dataclass(frozen=True)
class Arm:
    record: Record
    truth: np.ndarray  # (F,) response on OMEGA
    poles: np.ndarray  # the two real ones, then the three of the upper half plane, in z

    def model(self, n_modes=3):
        """Its poles without the last modes, coefficients zero."""
        poles = Poles(self.poles[:2].real, self.poles[2 : 2 + n_modes])
        return GobfModel(poles, np.zeros(poles.order), DT_S)


def random_arm(rng, n_samples=2000, snr_db=35.0, noise_pole=0.0):
    """One random plant, one random binary input, one noise realisation."""
    run = draw(Setting(n_samples, snr_db, random_plant=True, noise_pole=noise_pole), rng)
    poles = np.linalg.eigvals(run.system[0])
    poles = poles[np.argsort(np.angle(poles))]
    real = np.sort(poles[poles.imag == 0])[::-1]
    return Arm(run.record, run.response(OMEGA), np.concatenate([real, poles[poles.imag > 0]]))


def per_band(hits):
    """(runs, F) booleans -> coverage per band."""
    return np.array([hits[:, (low <= OMEGA) & (high > OMEGA)].mean() for low, high in BANDS])
