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
more than `_MOST_INDEPENDENT`.

Letters of the shapes: N coefficients of R records with Y outputs each, in B bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.fft import dct, idct

from diagnosis.fit.windows import Windows
from diagnosis.machine.machine_protocol import Real, RecordOfMachine

# Coefficients in the lowest band: of fewer a variance says nothing. Doubled, what is left of three machines
# beside a model error changes by up to 2 % (`python -m benchmarks.frozen_answers --change`).
_LOWEST_COEFFICIENTS = 4
# Independent values that a band counts as at most: its variance is then known to a third, sqrt(2 / 16). With
# more the highest octaves, which have most coefficients, decide alone: doubled, these leave up to 6 % more.
_MOST_INDEPENDENT = 16.0
# Share of the stated model error below which a gain is none: what does not interest is not fitted. Doubled,
# these leave up to 3 % more, and probabilities move by 0.02.
UNINTERESTING = 0.4
# Noise is allowed half as much again as a data sheet says before anything is called left over. Doubled,
# probabilities move by 0.01.
_NOISE_ALLOWED = 1.5


def octaves_of(samples: int) -> npt.NDArray[np.int64]:
    """(T,) octave of every coefficient of the cosine transform of T samples: 0 for the first four, then 1, 2,
    ... for 4 to 7, 8 to 15 and so on."""
    index = np.maximum(np.arange(samples), 1)
    octave = np.maximum(np.log2(index / _LOWEST_COEFFICIENTS), -1).astype(np.int64) + 1
    octave[: min(_LOWEST_COEFFICIENTS, samples)] = 0
    return octave


def quietest(signals: Sequence[Real]) -> Real:
    """(Y,) standard deviations of the most white noise that every signal may have.

    Parameters
    ----------
    signals : sequence of (T, Y) arrays
        At least one. White noise has the same RMS in every octave, so a signal has no more of it than its
        quietest octave that is long enough to tell; the largest over all signals is taken.
    """
    quietest_rms = []
    for signal in signals:
        octave = octaves_of(len(signal))
        counts = np.bincount(octave)
        is_long = counts >= min(_MOST_INDEPENDENT, float(np.max(counts)))
        coefficients = dct(signal, axis=0, norm="ortho")
        energies = np.array([np.bincount(octave, column * column) for column in coefficients.T])
        quietest_rms.append(np.sqrt(np.min(energies[:, is_long] / counts[is_long], axis=1)))
    return np.asarray(np.max(quietest_rms, axis=0))


@dataclass(frozen=True, eq=False)
class Levels:
    """Bands of the coefficients of some records, and the likelihood of residuals of unknown level in them.

    Attributes
    ----------
    band : (N,) int array
        Index of the band of every coefficient.
    independent_counts : (B,) array
        Independent values that a band counts as, n_b.
    floor : (B,) array
        Energy that does not interest, F_b, above 0; squares of the outputs' units.
    noise : (B,) array
        Energy that sensors may have, noise and rounding.
    output_of_band : (B,) int array
        Which of the R Y outputs of records a band is of.
    motion_energy : (R Y,) array
        Energy of the measured outputs, in windows where there are some.
    whole_motion_energy : (R Y,) array
        Energy of the measured outputs about their mean.
    windows : Windows or None
        Windows that the coefficients are of; None for whole records.
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
        """Bands of records.

        Parameters
        ----------
        records : sequence
            R records with Y outputs.
        noise : (Y,) array
            Standard deviations.
        model_error : float
            Share of the motion that a good model may miss, 0 to 1.
        rounded : (Y,) array or float
            Variances of rounding beside the noise.
        windows : Windows, optional
            The bands are then octaves of these, the motion what they have of it.
        """
        outputs = noise.size
        sensor_variance = noise**2 + rounded
        allowed_variance = _NOISE_ALLOWED**2 * noise**2 + rounded
        parts: dict[str, list[Any]] = {}
        first_band = 0
        for r, record in enumerate(records):
            samples = len(record.output)
            whole_motion_energy = samples * np.var(record.output, axis=0)
            if windows is None:
                octave = octaves_of(samples)
                motion_energy = whole_motion_energy
            else:
                groups = windows.window_groups(samples)
                octave = np.concatenate(
                    [np.tile(octaves_of(group.length), group.windows) for group in groups]
                )
                motion_energy = windows.motion(record.output)
            octaves = int(np.max(octave)) + 1
            counts = np.bincount(octave).astype(np.float64)
            uninteresting = (UNINTERESTING * model_error) ** 2 * motion_energy / octaves
            of_record = {
                "band": first_band + (octave[:, None] * outputs + np.arange(outputs)).ravel(),
                "independent_counts": np.repeat(np.minimum(counts, _MOST_INDEPENDENT), outputs),
                "floor": (counts[:, None] * sensor_variance + uninteresting).ravel(),
                "noise": (counts[:, None] * allowed_variance).ravel(),
                "output_of_band": np.tile(r * outputs + np.arange(outputs), octaves),
                "motion_energy": motion_energy,
                "whole_motion_energy": whole_motion_energy,
            }
            for name, values in of_record.items():
                parts.setdefault(name, []).append(values)
            first_band += octaves * outputs
        joined: dict[str, Any] = {name: np.concatenate(values) for name, values in parts.items()}
        return cls(**joined, windows=windows)

    def to_coefficients(self, residuals: Real) -> Real:
        """(T Y,) cosine transform of the residuals (T, Y) of one record, coefficient by coefficient."""
        return self.linearised(residuals).ravel()

    def to_residuals(self, e: Real, outputs: int) -> Real:
        """(T, Y) residuals of coefficients (T Y,); in windows without what starts of windows do."""
        coefficients = e.reshape(-1, outputs)
        if self.windows is not None:
            return self.windows.to_residuals(coefficients)
        return np.asarray(idct(coefficients, axis=0, norm="ortho"))

    def linearised(self, outputs: Real) -> Real:
        """(..., T, Y) cosine transforms of changes (..., T, Y); exact, for the transform is linear."""
        if self.windows is not None:
            return self.windows.to_coefficients(outputs)
        return np.asarray(dct(outputs, axis=-2, norm="ortho"))

    def energy(self, e: Real) -> Real:
        """(B,) energy of the coefficients (N,) in every band, E_b."""
        return np.asarray(np.bincount(self.band, e * e, minlength=self.floor.size), dtype=np.float64)

    def of_record(self, part: slice) -> Levels:
        """Bands of one record, which it has for itself.

        part : place of all its coefficients among the N; of a part of a record bands would be cut, and
        their energies too small.
        """
        band = self.band[part]
        bands = slice(int(band.min()), int(band.max()) + 1)
        output_of_band = self.output_of_band[bands]
        outputs = slice(int(output_of_band.min()), int(output_of_band.max()) + 1)
        return Levels(
            band=band - bands.start,
            independent_counts=self.independent_counts[bands],
            floor=self.floor[bands],
            noise=self.noise[bands],
            output_of_band=output_of_band - outputs.start,
            motion_energy=self.motion_energy[outputs],
            whole_motion_energy=self.whole_motion_energy[outputs],
            windows=self.windows,
        )

    def loss_of(self, energy: Real) -> float:
        """-log likelihood of energies (B,), up to a constant of the records."""
        return 0.5 * float(self.independent_counts @ np.log1p(energy / self.floor))

    def loss(self, e: Real) -> float:
        """-log likelihood of coefficients (N,), up to a constant of the records."""
        return self.loss_of(self.energy(e))

    def weights(self, e: Real) -> Real:
        """(N,) w with the gradient of the loss w e: the reciprocal variances that e itself shows."""
        return np.asarray((self.independent_counts / (self.energy(e) + self.floor))[self.band])
