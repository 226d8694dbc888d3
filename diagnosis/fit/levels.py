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
from scipy.fft import dct, idct

from diagnosis.machine.machine_protocol import Real, RecordOfMachine

_LOWEST = 4
_MOST = 16.0
# Share of the stated model error below which a gain is none: what does not interest is not fitted.
_UNINTERESTING = 0.4
# Noise is allowed half as much again as a data sheet says.
_NOISE_ALLOWED = 1.5


def octaves_of(samples: int) -> npt.NDArray[np.int64]:
    """(T,) octave of every coefficient of the cosine transform, the first four in one."""
    octave = np.maximum(np.log2(np.maximum(np.arange(samples), 1) / _LOWEST), -1).astype(np.int64) + 1
    octave[: min(_LOWEST, samples)] = 0
    return octave


def disturbance(signal: Real, rng: np.random.Generator) -> Real:
    """(T,) random, as large as a signal (T,), its octaves as large as they are there, but that they do not
    fall off towards low frequencies: a bias that changes is as likely as anything faster."""
    octave = octaves_of(signal.size)
    energy = octave_energies(signal[:, None])[:, 0]
    envelope = np.maximum.accumulate(energy[::-1])[::-1]
    size = np.sqrt(envelope * energy.sum() / (np.sum(envelope) or 1.0) / np.bincount(octave))
    return np.asarray(idct(size[octave] * rng.standard_normal(signal.size), norm="ortho"))


def octave_energies(signals: Real) -> Real:
    """(T, Y) -> (octaves, Y)"""
    octave = octaves_of(len(signals))
    return np.array([np.bincount(octave, c * c) for c in dct(signals, axis=0, norm="ortho").T]).T


def coefficients(residuals: Real) -> Real:
    """(T, Y) -> (T Y,): orthonormal cosine transform of every output, sample by sample."""
    return np.asarray(dct(residuals, axis=0, norm="ortho")).ravel()


def quietest(signals: Sequence[Real]) -> Real:
    """(Y,) white noise that no signal (T, Y) has more of: at most the RMS of its quietest octave."""
    rms = []
    for signal in signals:
        samples = np.bincount(octaves_of(len(signal)))
        many = samples >= min(_MOST, float(np.max(samples)))
        rms.append(np.sqrt(np.min(octave_energies(signal)[many] / samples[many, None], axis=0)))
    return np.asarray(np.max(rms, axis=0))


@dataclass(frozen=True, eq=False)
class Levels:
    """Bands of the coefficients of some records.

    band : (N,) index of the band of every coefficient. counted : (B,) independent values of a band.
    floor : (B,) energy F_b; noise : (B,) what sensors may have, noise and rounding. felt : (B,) what energy
    left in a band counts. belongs : (B,) which of the R Y outputs of records it is of; motion : (R Y,) their
    energies, counted so too.
    """

    band: npt.NDArray[np.int64]
    counted: Real
    floor: Real
    noise: Real
    felt: Real
    belongs: npt.NDArray[np.int64]
    motion: Real

    @classmethod
    def of(
        cls,
        records: Sequence[RecordOfMachine],
        noise: Real,
        model_error: float,
        amplified: Sequence[Real] = (),
        rounded: Real | float = 0.0,
    ) -> Levels:
        """noise (Y,): standard deviations; model_error: share of the motion that a good model may miss;
        rounded (Y,): variances of rounding beside the noise.

        amplified : of every record (octaves, Y), energy that a disturbance as large as its inputs has in its
            outputs. Octaves in which that is more than an even part of the motion count the less: a machine
            that integrates makes a motion of what nobody would call a model error, and a good model misses
            it. Empty: none is.
        """
        rows, first, Y = [], 0, noise.size
        for r, record in enumerate(records):
            T = len(record.output)
            octave = octaves_of(T)
            octaves = int(octave[-1]) + 1
            samples = np.bincount(octave).astype(np.float64)
            motion = T * np.var(record.output, axis=0)
            felt = np.ones((octaves, Y))
            if amplified:
                even = motion / octaves
                felt = even / np.maximum(even, amplified[r])
                centred = record.output - np.mean(record.output, axis=0)
                motion = np.sum(felt * octave_energies(centred), axis=0)
            floor = (_UNINTERESTING * model_error) ** 2 * motion / octaves / felt
            rows.append(
                (
                    first + (octave[:, None] * Y + np.arange(Y)).ravel(),
                    np.repeat(np.minimum(samples, _MOST), Y),
                    (samples[:, None] * (noise**2 + rounded) + floor).ravel(),
                    (samples[:, None] * (_NOISE_ALLOWED**2 * noise**2 + rounded)).ravel(),
                    felt.ravel(),
                    np.tile(r * Y + np.arange(Y), octaves),
                    motion,
                )
            )
            first += octaves * Y
        return cls(*(np.concatenate(column) for column in zip(*rows, strict=True)))

    def seen(self, residuals: Real) -> Real:
        """See `diagnosis.fit.likelihood.Likelihood`."""
        return coefficients(residuals)

    def unseen(self, e: Real, outputs: int) -> Real:
        return np.asarray(idct(e.reshape(-1, outputs), axis=0, norm="ortho"))

    def changed(self, outputs: Real) -> Real:
        return np.asarray(dct(outputs, axis=-2, norm="ortho"))

    def energy(self, e: Real) -> Real:
        return np.asarray(np.bincount(self.band, e * e, minlength=self.floor.size), dtype=np.float64)

    def within(self, part: slice) -> Levels:
        """Of the record that has this part of the coefficients."""
        band = self.band[part]
        own = slice(int(band.min()), int(band.max()) + 1)
        belongs = self.belongs[own]
        first = int(belongs.min())
        return Levels(
            band - own.start,
            self.counted[own],
            self.floor[own],
            self.noise[own],
            self.felt[own],
            belongs - first,
            self.motion[first : int(belongs.max()) + 1],
        )

    def loss_of(self, energy: Real) -> float:
        """-log likelihood of energies (B,)."""
        return 0.5 * float(self.counted @ np.log1p(energy / self.floor))

    def loss(self, e: Real) -> float:
        """-log likelihood of coefficients (N,), up to a constant of the records."""
        return self.loss_of(self.energy(e))

    def weights(self, e: Real) -> Real:
        """(N,) w with grad(loss) = w e: the reciprocal variances that e itself shows."""
        return np.asarray((self.counted / (self.energy(e) + self.floor))[self.band])
