"""Repeats of one experiment at one amplitude or several: what scatters, and what the amplitude changes,
without a model.

Records whose excitation (the reference of a closed loop, else the input) has the same course are one
experiment; its size is its amplitude. Repeats of an amplitude differ by noise and change from run to run. Of
a linear arm the response does not depend on amplitude.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import f

from ident.data.arrays import ComplexArray, RealArray
from ident.data.distortion import EXCITED, SAME
from ident.data.finding import TEST_LEVEL
from ident.data.nonparametric import spectra_of
from ident.data.record import Record, in_groups

# Lines averaged for one estimate: five.
_HALF_WIDTH = 2
# Bands in which it is looked for, a decade.
_PER_DECADE = 8
_FEWEST = 3  # frequencies in a band: of fewer there is no slope beside its mean


@dataclass(frozen=True)
class AmplitudeBand:
    """Largest against smallest amplitude in a band, as shares of the response, RMS.

    difference: between the means, noise taken off; chance: by the scatter of the repeats alone; scatter: of
    one repeat, mean of both; gain: mean relative change; shift: relative change of the frequencies of
    resonances and zeros that fits the rest best; level_share, shift_share: of the difference's power, what
    one change of gain and phase for the band explains, and the shift; probability: of so large a difference
    by chance.
    """

    from_rad_s: float
    to_rad_s: float
    difference: float
    chance: float
    scatter: float
    gain: float
    shift: float
    level_share: float
    shift_share: float
    probability: float


@dataclass(frozen=True, eq=False)
class Repeats:
    """One experiment: C amplitudes rms (C,) of the excitation, ascending, each recorded at least twice.

    omega_rad_s (F,): middles of the averaging widths; responses: per amplitude (K, F), one row a record;
    names: of the records, per amplitude.
    """

    rms: tuple[float, ...]
    names: tuple[tuple[str, ...], ...]
    omega_rad_s: RealArray
    responses: tuple[ComplexArray, ...]

    def scatter(self, amplitude: int) -> float:
        """Of one repeat at an amplitude, over the response, median over frequency."""
        each = self.responses[amplitude]
        return float(np.median(each.std(axis=0, ddof=1) / np.abs(each.mean(axis=0))))

    @property
    def amplitude_effects(self) -> tuple[AmplitudeBand, ...]:
        """Where the response differs between amplitudes by more than chance at 99 %, all bands together:
        by eighths of a decade; none with one amplitude."""
        low, high = self.omega_rad_s[0] * (1 - 1e-9), self.omega_rad_s[-1] * (1 + 1e-9)
        edges = np.geomspace(low, high, max(round(_PER_DECADE * np.log10(high / low)), 1) + 1).tolist()
        bands = [self.across_amplitudes(*ends) for ends in pairwise(edges)]
        limit = (1 - TEST_LEVEL) / max(sum(band is not None for band in bands), 1)
        return tuple(band for band in bands if band is not None and band.probability < limit)

    def across_amplitudes(self, low_rad_s: float, high_rad_s: float) -> AmplitudeBand | None:
        """None with one amplitude, or fewer than three frequencies in the band.

        Frequencies count by the power of their response. Dempster's test (Annals of Mathematical Statistics
        29(4), 1958): power of the difference over that of the scatter, against F(2 r, 2 r n), n complex
        degrees of freedom of the repeats (Welch's) and r = tr(S)^2 / tr(S^2) independent errors in the band,
        S their covariance between frequencies, freed of the bias of few repeats.
        """
        at = (self.omega_rad_s >= low_rad_s) & (self.omega_rad_s < high_rad_s)
        if len(self.rms) < 2 or np.count_nonzero(at) < _FEWEST:
            return None
        first, last = (self.responses[end][:, at] for end in (0, -1))
        middle = 0.5 * (first.mean(axis=0) + last.mean(axis=0))
        change = (last.mean(axis=0) - first.mean(axis=0)) / middle
        weight = np.abs(middle) ** 2 / np.sum(np.abs(middle) ** 2)
        apart = [(each - each.mean(axis=0)) / middle * np.sqrt(weight) for each in (first, last)]
        variances = [float(np.sum(np.abs(each) ** 2)) / (len(each) - 1) for each in apart]
        parts = np.array(variances) / [len(first), len(last)]
        power, noise = float(weight @ np.abs(change) ** 2), float(parts.sum())
        freedom = noise**2 / float(np.sum(parts**2 / [len(first) - 1, len(last) - 1]))
        independent = _independent(np.vstack(apart), len(first) + len(last) - 2)
        slope = -np.gradient(
            np.log(np.abs(middle)) + 1j * np.unwrap(np.angle(middle)), np.log(self.omega_rad_s[at])
        )
        slope -= weight @ slope  # a constant slope cannot be told from a change of the whole band
        level, steep = complex(weight @ change), float(weight @ np.abs(slope) ** 2)
        shift = float(weight @ (change * slope.conj()).real) / steep
        beyond = max(power - noise, np.finfo(np.float64).tiny)
        return AmplitudeBand(
            low_rad_s,
            high_rad_s,
            difference=float(np.sqrt(max(power - noise, 0.0))),
            chance=float(np.sqrt(noise)),
            scatter=float(np.sqrt(np.mean(variances))),
            gain=level.real,
            shift=shift,
            level_share=abs(level) ** 2 / beyond,
            shift_share=shift**2 * steep / beyond,
            probability=float(f.sf(power / noise, 2 * independent, 2 * independent * freedom)),
        )


def _independent(deviations: ComplexArray, freedom: int) -> float:
    """Independent errors among those of neighbouring frequencies, from deviations (K, F) of complex repeats
    with `freedom` n: tr(S)^2 / tr(S^2), where of the sample covariance n tr(S_hat^2) has tr(S)^2 too much."""
    inner = deviations @ deviations.conj().T / freedom
    total, square = float(np.trace(inner).real), float(np.sum(np.abs(inner) ** 2))
    if freedom < 2:
        return 1.0
    unbiased = freedom**2 / (freedom**2 - 1) * (square - total**2 / freedom)
    return (
        float(np.clip(total**2 / unbiased, 1.0, deviations.shape[1]))
        if unbiased > 0
        else float(deviations.shape[1])
    )


def repeats_of(records: Sequence[Record]) -> tuple[Repeats, ...]:
    """Every experiment among SISO records that has an amplitude with two records or more; amplitudes with a
    single one are left out. Raises ValueError for several inputs or outputs."""
    for record in records:
        record.refuse_several()
    signals = [(one, (one.input if one.reference is None else one.reference)[:, 0]) for one in records]
    moving = [(one, np.asarray(signal - signal.mean())) for one, signal in signals if np.ptp(signal) > 0]
    found = (_experiment(form) for form in in_groups(moving, _alike))
    return tuple(experiment for experiment in found if experiment is not None)


def _alike(one: tuple[Record, RealArray], another: tuple[Record, RealArray]) -> bool:
    """Excited in the same way, whatever the size."""
    (record, course), (other, its) = one, another
    if course.size != its.size or record.dt_s != other.dt_s:
        return False
    return bool(np.linalg.norm(course / np.linalg.norm(course) - its / np.linalg.norm(its)) < SAME)


def _experiment(form: Sequence[tuple[Record, RealArray]]) -> Repeats | None:
    sized = sorted(((float(np.std(course)), record) for record, course in form), key=lambda pair: pair[0])
    amplitudes: list[list[tuple[float, Record]]] = []
    for size, record in sized:
        if amplitudes and size < (1 + SAME) * amplitudes[-1][0][0]:
            amplitudes[-1].append((size, record))
        else:
            amplitudes.append([(size, record)])
    repeated = [same for same in amplitudes if len(same) > 1]
    if not repeated:
        return None
    spectra = spectra_of([record for same in repeated for _, record in same], periodic=False)
    power = np.mean(np.abs(spectra.instrument) ** 2, axis=0)
    excited = np.flatnonzero(power > EXCITED * power.max())
    width = 2 * _HALF_WIDTH + 1
    count = excited.size // width
    if count < 3:
        return None
    lines = excited[: count * width].reshape(count, width)
    w = spectra.instrument[:, lines].conj()
    through = np.sum(spectra.input[:, lines] * w, axis=2)
    if np.any(through == 0):
        return None
    response = np.sum(spectra.output[:, lines] * w, axis=2) / through
    ends = np.cumsum([len(same) for same in repeated])[:-1]
    return Repeats(
        tuple(float(np.mean([size for size, _ in same])) for same in repeated),
        tuple(tuple(record.name for _, record in same) for same in repeated),
        spectra.omega_rad_s[lines].mean(axis=1),
        tuple(np.split(response, ends)),
    )
