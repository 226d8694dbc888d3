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
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.fft import dct, idct

from diagnosis.fit.windows import Windows
from diagnosis.machine.machine_protocol import Real, RecordOfMachine

_LOWEST = 4  # coefficients in the lowest band: of fewer a variance says nothing
_MOST = 16.0  # of one band, see above: its variance is then known to a third, sqrt(2 / 16)
# Share of the stated model error below which a gain is none: what does not interest is not fitted.
UNINTERESTING = 0.4
# Noise is allowed half as much again as a data sheet says.
_NOISE_ALLOWED = 1.5


def octaves_of(samples: int) -> npt.NDArray[np.int64]:
    """(T,) octave of every coefficient of the cosine transform, the first four in one."""
    octave = np.maximum(np.log2(np.maximum(np.arange(samples), 1) / _LOWEST), -1).astype(np.int64) + 1
    octave[: min(_LOWEST, samples)] = 0
    return octave


def quietest(signals: Sequence[Real]) -> Real:
    """(Y,) white noise that no signal (T, Y) has more of: at most the RMS of its quietest octave."""
    rms = []
    for signal in signals:
        octave = octaves_of(len(signal))
        samples = np.bincount(octave)
        many = samples >= min(_MOST, float(np.max(samples)))
        energies = np.array([np.bincount(octave, c * c) for c in dct(signal, axis=0, norm="ortho").T])
        rms.append(np.sqrt(np.min(energies[:, many] / samples[many], axis=1)))
    return np.asarray(np.max(rms, axis=0))


@dataclass(frozen=True, eq=False)
class Levels:
    """Bands of the coefficients of some records.

    band : (N,) index of the band of every coefficient. counted : (B,) independent values of a band.
    floor : (B,) energy F_b; noise : (B,) what sensors may have, noise and rounding. belongs : (B,) which of
    the R Y outputs of records it is of; motion : (R Y,) their energies, whole : about the mean of the record.
    windows : that the coefficients are of.
    """

    band: npt.NDArray[np.int64]
    independent_counts: Real
    floor: Real
    noise: Real
    output_of_band: npt.NDArray[np.int64]
    motion_energy: Real
    whole_motion_energy: Real
    windows: Windows | None = field(default=None, kw_only=True)

    @classmethod
    def of(
        cls,
        records: Sequence[RecordOfMachine],
        noise: Real,
        model_error: float,
        rounded: Real | float = 0.0,
        windows: Windows | None = None,
    ) -> Levels:
        """noise (Y,): standard deviations; model_error: share of the motion that a good model may miss;
        rounded (Y,): variances of rounding beside the noise. In windows the bands are octaves of these, the
        motion what they have of it."""
        rows, first, Y = [], 0, noise.size
        for r, record in enumerate(records):
            T = len(record.output)
            parts = windows.window_groups(T) if windows else [(slice(0, T), 1, T)]
            octave = np.concatenate([np.tile(octaves_of(length), count) for _, count, length in parts])
            octaves = int(np.max(octave)) + 1
            samples = np.bincount(octave).astype(np.float64)
            whole = T * np.var(record.output, axis=0)
            motion = windows.motion(record.output) if windows else whole
            floor = (UNINTERESTING * model_error) ** 2 * motion / octaves
            rows.append(
                (
                    first + (octave[:, None] * Y + np.arange(Y)).ravel(),
                    np.repeat(np.minimum(samples, _MOST), Y),
                    (samples[:, None] * (noise**2 + rounded) + floor).ravel(),
                    (samples[:, None] * (_NOISE_ALLOWED**2 * noise**2 + rounded)).ravel(),
                    np.tile(r * Y + np.arange(Y), octaves),
                    motion,
                    whole,
                )
            )
            first += octaves * Y
        return cls(*(np.concatenate(column) for column in zip(*rows, strict=True)), windows=windows)

    def to_coefficients(self, residuals: Real) -> Real:
        """See `diagnosis.fit.likelihood.Likelihood`."""
        return self.linearised(residuals).ravel()

    def to_residuals(self, e: Real, outputs: int) -> Real:
        e = e.reshape(-1, outputs)
        return self.windows.to_residuals(e) if self.windows else np.asarray(idct(e, axis=0, norm="ortho"))

    def linearised(self, outputs: Real) -> Real:
        return (
            self.windows.to_coefficients(outputs)
            if self.windows
            else np.asarray(dct(outputs, axis=-2, norm="ortho"))
        )

    def energy(self, e: Real) -> Real:
        return np.asarray(np.bincount(self.band, e * e, minlength=self.floor.size), dtype=np.float64)

    def of_record(self, part: slice) -> Levels:
        """Of the record that has this part of the coefficients."""
        band = self.band[part]
        own = slice(int(band.min()), int(band.max()) + 1)
        belongs = self.output_of_band[own]
        outputs = slice(int(belongs.min()), int(belongs.max()) + 1)
        return Levels(
            band - own.start,
            self.independent_counts[own],
            self.floor[own],
            self.noise[own],
            belongs - outputs.start,
            self.motion_energy[outputs],
            self.whole_motion_energy[outputs],
            windows=self.windows,
        )

    def loss_of(self, energy: Real) -> float:
        """-log likelihood of energies (B,)."""
        return 0.5 * float(self.independent_counts @ np.log1p(energy / self.floor))

    def loss(self, e: Real) -> float:
        """-log likelihood of coefficients (N,), up to a constant of the records."""
        return self.loss_of(self.energy(e))

    def weights(self, e: Real) -> Real:
        """(N,) w with grad(loss) = w e: the reciprocal variances that e itself shows."""
        return np.asarray((self.independent_counts / (self.energy(e) + self.floor))[self.band])
