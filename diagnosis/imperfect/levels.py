"""The likelihood of residuals whose levels nobody knows: one level per record, output and octave.

Residuals of a good model of a real machine are coloured, far above the sensor noise, and different in size
from band to band and record to record. In the orthonormal cosine transform (which no drift leaks out of)
the coefficients of an octave are taken as independent with one variance; with an inverse-gamma prior that
variance is integrated out of the Whittle likelihood (Roever, Meyer and Christensen 2011), which leaves

    -log p = 1/2 sum_b n_b log(1 + E_b / F_b),

E_b being the energy of the residuals in band b, F_b the energy that does not interest there: sensor noise,
and the stated model error spread evenly over the octaves. A band that nothing explains stops counting;
removing a share of one counts whatever its size. Coefficients of one band are not as many independent
witnesses as they are numbers where what is left is a deterministic function of the motion: no band counts
more than `_MOST`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.fft import dct

from diagnosis.machine.machine_protocol import Real, RecordOfMachine

_LOWEST = 4
_MOST = 16.0
# Share of the stated model error below which a gain is none: what does not interest is not fitted.
_UNINTERESTING = 0.4


def coefficients(residuals: Real) -> Real:
    """(T, Y) -> (T Y,): orthonormal cosine transform of every output, sample by sample."""
    return np.asarray(dct(residuals, axis=0, norm="ortho")).ravel()


@dataclass(frozen=True, eq=False)
class Levels:
    """Bands of the coefficients of some records.

    band : (N,) index of the band of every coefficient. counted : (B,) independent values of a band.
    floor : (B,) energy F_b.
    """

    band: npt.NDArray[np.int64]
    counted: Real
    floor: Real

    @classmethod
    def of(cls, records: Sequence[RecordOfMachine], noise: Real, model_error: float) -> Levels:
        """noise (Y,): standard deviations; model_error: share of the motion that a good model may miss."""
        bands, counted, floors, first = [], [], [], 0
        for record in records:
            T, Y = record.output.shape
            octave = np.maximum(np.log2(np.maximum(np.arange(T), 1) / _LOWEST), -1).astype(np.int64) + 1
            octave[: min(_LOWEST, T)] = 0
            octaves = int(octave[-1]) + 1
            bands.append(first + (octave[:, None] * Y + np.arange(Y)).ravel())
            first += octaves * Y
            samples = np.bincount(octave, minlength=octaves).astype(np.float64)
            motion = T * np.var(record.output, axis=0) / octaves
            counted.append(np.repeat(np.minimum(samples, _MOST), Y))
            floors.append(
                (samples[:, None] * noise**2 + (_UNINTERESTING * model_error) ** 2 * motion).ravel()
            )
        return cls(np.concatenate(bands), np.concatenate(counted), np.concatenate(floors))

    def energy(self, e: Real) -> Real:
        return np.asarray(np.bincount(self.band, e * e, minlength=self.floor.size), dtype=np.float64)

    def loss_of(self, energy: Real, bands: slice = slice(None)) -> float:
        """-log likelihood of the energies (.,) of these bands."""
        return 0.5 * float(self.counted[bands] @ np.log1p(energy / self.floor[bands]))

    def loss(self, e: Real) -> float:
        """-log likelihood of coefficients (N,), up to a constant of the records."""
        return self.loss_of(self.energy(e))

    def weights(self, e: Real) -> Real:
        """(N,) w with grad(loss) = w e: the reciprocal variances that e itself shows."""
        return np.asarray((self.counted / (self.energy(e) + self.floor))[self.band])
