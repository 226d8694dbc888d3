"""The arm with its friction as a linear response, as it is at one amplitude.

A nonlinear arm answers a random-phase multisine with its best linear approximation (BLA) and a rest that is
uncorrelated with the input (Pintelon and Schoukens, System Identification: A Frequency Domain Approach, 2nd
ed., ch. 3). For dry friction it is an equivalent viscous friction, f = N d theta/dt (statistical
linearisation):

    BLA = G / (1 + j omega N G_shaft),
    N(j omega) = n_0 + n_1 j omega + n_2 (j omega)^2 + n_3 (j omega)^3 + n_4 j omega / (j omega + corner),

the last where the shaft has a corner, below which the input moves it at a speed. N comes from simulations of
the identified arm at the rms of the records, G and the friction's level from their common posterior. N at
each line is that of a weak one, times `more_at_a_strong_line`; a quarter of the largest of these stays
uncertain, in size and in phase.

Neglected: every other nonlinearity, and how N depends on the arm's coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm, logm
from scipy.special import ive

from ident.basis.functions import basis_response
from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.basis.structure import front_response
from ident.data.arrays import ComplexArray, RealArray, real_rows
from ident.data.distortion import period_of
from ident.data.record import Record
from ident.friction.arm import FASTEST_POLE, SteppedArm
from ident.friction.gauss_newton import CHANGE_OF_LOG, FrictionFit
from ident.friction.posterior import BehindFriction

# Realisations of the input that are averaged. Chosen: what they leave open is in the ellipses.
_REALISATIONS = 128
# Draws of the posterior whose spread is taken: they leave 1 / sqrt(800) of a standard deviation open.
_DRAWS = 400
# The first period dies out from rest, the second is in steady state.
_PERIODS = 2
# A line of the spectrum counts as excited above this share of the largest. Chosen.
_EXCITED = 1e-3
# Frequencies of the fit: over five decades 30 in every half decade that is counted.
_N_GRID = 300
# Lowest of them, as a share of the lowest excited line. Chosen: below it N goes on as a constant.
_BELOW_LINES = 0.5
# Of how much larger N is at the strongest line, what stays open of N at every line, in size and in phase.
# With a half of it open, and N one smooth curve, ellipses were four to five times their error.
_UNEVEN = 0.25
# Places of the grid beside a pole pair, in half bandwidths: a mode is followed by its peak and both flanks.
_HALF_WIDTHS = np.array([-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0])
# Powers of j omega that N is a sum of: a cubic.
_POWERS = 4
# Imaginary part below which a damped pole counts as real: rounding of an eigenvalue.
_REAL = 1e-9
# Largest change of the level for its derivative, in standard deviations, where it is hardly told from none.
_LEVEL_STEP = 0.5
# Least share of the power in all other lines: a single line would divide by zero.
_LEAST_OTHERS = 1e-9
# Smallest singular value of the fit on poles that counts, as a share of the largest. Nearly equal poles would
# get large coefficients otherwise.
_RANK = 1e-10


@dataclass(frozen=True, eq=False)
class EquivalentFriction:
    """The viscous friction that acts like the dry one, on average, at an amplitude of the input.

    Attributes
    ----------
    friction : FrictionFit
        What it was simulated from.
    rms : float
        Of the input.
    omega_rad_s : ndarray, shape (F,)
        Excited lines.
    stronger : ndarray, shape (F,)
        How much larger N is there than at a weak line, relative to it.
    mean, by_level : ndarray, shape (M,)
        Coefficients of N at a weak line (`_terms`), in units of the input per speed, and their derivative by
        the level.
    factor : ndarray, shape (M, M)
        Of the covariance of the mean, what the simulations leave open.
    """

    friction: FrictionFit
    rms: float
    omega_rad_s: RealArray
    stronger: RealArray
    mean: RealArray
    by_level: RealArray
    factor: RealArray

    @property
    def damping(self) -> float:
        """N at low frequency, in units of the input per (unit of position / s), not below zero."""
        return max(float(self.mean[0]), 0.0)

    def drawn(self, change: RealArray, omega: RealArray, rng: np.random.Generator) -> ComplexArray:
        """Drawn values (K, W) of N, in units of the input per (unit of position / s).

        Parameters
        ----------
        change : ndarray, shape (K,)
            Of the friction's level, units of the input.
        omega : ndarray, shape (W,)
            Frequencies, rad/s; above the last line N stays what it is there.
        rng : numpy.random.Generator

        Returns
        -------
        ndarray of complex, shape (K, W)
        """
        normals = rng.standard_normal((change.size, self.factor.shape[1]))
        uneven = rng.standard_normal((change.size, 2)) @ (1, 1j)
        values = self.mean + change[:, None] * self.by_level + normals @ self.factor.T
        # No line says how N goes on beyond the last.
        inside = np.minimum(omega, self.omega_rad_s[-1])
        terms = _terms(inside, self.omega_rad_s[-1], _corner(self.friction.arm))
        smooth = values @ terms.T
        stronger = np.interp(omega, self.omega_rad_s, self.stronger)
        open_share = (_UNEVEN * self.stronger.max()) * uneven
        return np.asarray(smooth * (1 + stronger + open_share[:, None]))


def equivalent_friction(
    friction: FrictionFit,
    records: Sequence[Record],
    rng: np.random.Generator,
) -> EquivalentFriction:
    """Equivalent friction of random-phase multisines like the records.

    Parameters
    ----------
    friction : FrictionFit
    records : sequence of Record
        Their power spectrum, and the rms of them together, are those of the multisines.
    rng : numpy.random.Generator
        Draws the phases.

    Returns
    -------
    EquivalentFriction
    """
    rms = float(np.sqrt(np.mean([np.mean(record.input[:, 0] ** 2) for record in records])))
    spectrum = _power_spectrum(records)
    lines = np.flatnonzero(spectrum > _EXCITED * spectrum.max())
    line_spacing = np.pi / ((spectrum.size - 1) * friction.arm.dt_s)
    omega = lines.astype(np.float64) * line_spacing
    return EquivalentFriction(friction, rms, omega, *_simulated(friction, spectrum, lines, rms, rng))


def at_amplitude(
    behind: BehindFriction, equivalent: EquivalentFriction, rng: np.random.Generator
) -> tuple[ResponsePosterior, Poles]:
    """Posterior of the best linear approximation, and poles of a model of it.

    Parameters
    ----------
    behind : BehindFriction
        Response, shaft and level on common unit normals.
    equivalent : EquivalentFriction
    rng : numpy.random.Generator

    Returns
    -------
    tuple of ResponsePosterior and Poles
        Mean and covariance of 400 draws of G / (1 + j omega N G_shaft), on the poles of the arm with its
        equivalent damping and on those that G stands on; and the damped poles.
    """
    friction = behind.friction
    arm = friction.arm
    lowest = _BELOW_LINES * equivalent.omega_rad_s[0]
    spaced = np.geomspace(lowest, np.pi / arm.dt_s, _N_GRID)
    # Within and beside the half bandwidths of every pole pair, too: a mode that may have been missed is
    # narrower than the grid, and coefficients nobody looked at may have any size.
    poles = behind.response.poles
    half_widths = poles.zeta()[:, None] * _HALF_WIDTHS
    near = poles.omega_rad_s(arm.dt_s)[:, None] * (1 + half_widths)
    is_inside = (near > spaced[0]) & (near < spaced[-1])
    omega = np.unique(np.concatenate([spaced, near[is_inside]]))

    # Arm, shaft and level of one draw belong to one arm: they stand on the same normals.
    normals = rng.standard_normal((_DRAWS, behind.level_factor.size))
    coefficients = behind.response.mean + normals @ behind.response.covariance_factor.T
    shaft = behind.shaft.mean + normals @ behind.shaft.covariance_factor.T
    change = behind.level + normals @ behind.level_factor - equivalent.friction.level
    # Friction is not delayed as the input is.
    undelayed = np.exp(1j * omega * arm.dt_s * arm.structure.input_delay_samples)
    speed = 1j * omega * undelayed * behind.shaft.response_of(shaft, omega)
    linear = behind.response.response_of(coefficients, omega)
    responses = linear / (1 + speed * equivalent.drawn(change, omega, rng))

    damped = damped_poles(friction.model, equivalent.damping)
    form, draws = _on_poles(behind.response, damped, coefficients, responses, omega)
    centre = draws.mean(axis=0)
    factor = np.asarray(np.linalg.qr((draws - centre) / np.sqrt(_DRAWS - 1), mode="r")).T
    return replace(form, mean=centre, covariance_factor=factor), damped


def _corner(arm: SteppedArm) -> float:
    """Rate [rad/s] of the slowest real pole: below it the input moves the shaft at a speed, above it not.

    inf where the arm has no real pole that decays.
    """
    decays = (arm.poles.real > 0) & (arm.poles.real < 1)
    real = arm.poles.real[decays]
    return float(-np.log(np.max(real)) / arm.dt_s) if real.size else np.inf


def _terms(omega: RealArray, last: float, corner: float) -> ComplexArray:
    """Terms (F, M) that N is a sum of at omega (F,), without unit.

    Powers of j omega / last, and a step at the corner of the shaft's speed where that is finite; all rates
    are in rad/s.
    """
    powers = (1j * omega / last)[:, None] ** np.arange(_POWERS)
    if not np.isfinite(corner):
        return np.asarray(powers)
    return np.column_stack([powers, 1j * omega / (1j * omega + corner)])


def more_at_a_strong_line(share: RealArray) -> RealArray:
    """How much larger N is at a line than at a weak one, relative to that.

    Parameters
    ----------
    share : ndarray, shape (F,)
        Of each line in the power of the speed, 0 to 1.

    Returns
    -------
    ndarray, shape (F,)
        0 for a line without power, to 1.

    Notes
    -----
    I1(h) / I0(h), h = share / (1 - share) / 2: two-input describing function of the sign.

    References
    ----------
    Gelb and Vander Velde, Multiple-Input Describing Functions, 1968.
    """
    half_ratio = 0.5 * share / np.maximum(1 - share, _LEAST_OTHERS)
    return np.asarray(ive(1, half_ratio) / ive(0, half_ratio))


def damped_poles(model: GobfModel, damping: float) -> Poles:
    """Poles of a shaft's model with more viscous friction at the shaft.

    Parameters
    ----------
    model : GobfModel
        Of the shaft's position.
    damping : float
        In units of the model's input per (unit of position / s).

    Returns
    -------
    Poles
        Sampled; integrators are left out.

    Notes
    -----
    In continuous time behind the hold: x' = A x + B (u - damping C A x).
    """
    real = np.maximum(model.poles.real, FASTEST_POLE)  # a pole at zero has no rate
    arm = replace(model, poles=Poles(real, model.poles.pairs), input_delay_samples=0).to_control()
    n = arm.nstates
    dt_s = model.dt_s
    # The logarithm of the sampled arm with its held input beside it is the arm in continuous time.
    held_input = [np.zeros((1, n)), np.ones((1, 1))]
    rates = np.real(logm(np.block([[arm.A, arm.B], held_input]))) / dt_s
    a = rates[:n, :n]
    b = rates[:n, n:]
    poles = np.linalg.eigvals(expm((a - damping * b @ arm.C @ a) * dt_s))
    # The integrators stay: friction that grows with speed holds no position.
    poles = poles[np.argsort(np.abs(poles - 1))][model.integrators :]
    is_real = np.abs(poles.imag) < _REAL
    upper = poles.imag >= _REAL
    return Poles(np.sort(poles[is_real].real), poles[upper].astype(np.complex128))


def _simulated(
    friction: FrictionFit,
    spectrum: RealArray,
    lines: npt.NDArray[np.intp],
    rms: float,
    rng: np.random.Generator,
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """N as simulations of the arm with its friction show it, at excited lines.

    Parameters
    ----------
    friction : FrictionFit
    spectrum : ndarray, shape (L,)
        Amplitudes of all lines of a period of 2 (L - 1) samples.
    lines : ndarray of int, shape (F,)
        The excited ones.
    rms : float
        Of the input.
    rng : numpy.random.Generator

    Returns
    -------
    tuple of ndarray
        How much larger N is at every line than at a weak one (F,), coefficients (M,) of N at such a one,
        their derivative (M,) by the level, factor (M, M) of their covariance.
    """
    period = 2 * (spectrum.size - 1)
    arm = friction.arm
    structure = arm.structure
    omega = lines.astype(np.float64) * (2 * np.pi / (period * arm.dt_s))
    z = np.exp(1j * omega * arm.dt_s)
    delayed = z ** -float(structure.input_delay_samples)
    front = front_response(omega, arm.dt_s, structure.integrators, 0)
    speed = 1j * omega * front * (basis_response(arm.poles.doubled(), z) @ friction.coefficients)
    terms = _terms(omega, omega[-1], _corner(arm))
    # Multisines of random phases, each at the rms, repeated.
    phases = np.exp(2j * np.pi * rng.random((_REALISATIONS, spectrum.size)))
    inputs = []
    for phase in phases:
        sines = np.fft.irfft(spectrum * phase, period)
        inputs.append(np.tile(rms * sines / np.sqrt(np.mean(sines**2)), _PERIODS))

    def simulated(level: float) -> ComplexArray:
        """Friction over input (R, F) of each realisation at a level, line by line in steady state."""
        ratios = np.empty((_REALISATIONS, lines.size), dtype=np.complex128)
        law = replace(friction.law, level=level)
        for row, u in zip(ratios, inputs, strict=True):
            force = arm.run(friction.coefficients, u, law)[1]
            row[:] = np.fft.rfft(force[-period:])[lines] / np.fft.rfft(u[-period:])[lines]
        return ratios

    ratios = simulated(friction.level)
    amplitude = speed * (delayed - ratios.mean(axis=0)) * spectrum[lines]
    power = np.abs(amplitude) ** 2
    stronger = more_at_a_strong_line(power / power.sum())
    terms *= (1 + stronger)[:, None]

    def solved(ratios: ComplexArray) -> tuple[RealArray, RealArray]:
        """N (M,) of friction over input (R, F), and how far each realisation (R, M) would move it.

        H = N j omega G (z^-d - H) with H the mean of the ratios; what it leaves is the relative error of the
        best linear approximation.
        """
        mean = ratios.mean(axis=0)
        columns = (speed * (delayed - mean))[:, None] * terms
        inverse = np.linalg.pinv(real_rows(columns))
        n = inverse @ real_rows(mean)
        deviation = (ratios - mean) * (1 + speed * (terms @ n))
        return n, np.hstack([deviation.real, deviation.imag]) @ inverse.T

    n, moves = solved(ratios)
    # A level that is not told from none has its uncertainty for a step, and cannot be negative.
    step = max(CHANGE_OF_LOG * friction.level, _LEVEL_STEP * friction.level_std)
    upper_level = friction.level + step
    lower_level = max(friction.level - step, 0.0)
    above = solved(simulated(upper_level))[0]
    below = solved(simulated(lower_level))[0]
    by_level = (above - below) / (upper_level - lower_level)
    left_open = np.asarray(np.linalg.qr((moves - moves.mean(axis=0)) / _REALISATIONS, mode="r")).T
    return stronger, n, by_level, left_open


def _power_spectrum(records: Sequence[Record]) -> RealArray:
    """Amplitudes (L,) of the lines of a period, or of a whole record where its input does not repeat.

    They have the length of the longest one (of an even number of samples); all records weigh alike.
    """
    inputs = []
    for record in records:
        u = record.input[:, 0]
        period = period_of(u)
        inputs.append(u if period is None else u[-period:])
    longest = max(u.size for u in inputs) // 2 * 2
    grid = np.linspace(0, 1, longest // 2 + 1)
    power = np.zeros(longest // 2 + 1)
    for u in inputs:
        record_power = np.abs(np.fft.rfft(u)) ** 2
        record_grid = np.linspace(0, 1, record_power.size)
        power += np.interp(grid, record_grid, record_power / record_power.sum())
    # Neither the mean nor the Nyquist line has a phase to draw.
    power[0] = 0.0
    power[-1] = 0.0
    return np.sqrt(power)


def _on_poles(
    response: ResponsePosterior,
    damped: Poles,
    coefficients: RealArray,
    responses: ComplexArray,
    omega: RealArray,
) -> tuple[ResponsePosterior, RealArray]:
    """Drawn responses (K, F) at omega (F,) as coefficients (K, P), and the form they stand in, its mean zero.

    The form has the damped poles, twice since N depends on frequency, and those of the response as often as
    they stand there; taps (K, ...) are those of the drawn `coefficients` of the response.
    """
    own_poles = response.poles
    parts = (damped, damped, own_poles)
    poles = Poles(
        np.concatenate([part.real for part in parts]), np.concatenate([part.pairs for part in parts])
    )
    size = poles.order + response.fir_length
    form = replace(response, poles=poles, mean=np.zeros(size), covariance_factor=np.zeros((size, 1)))
    rows = form.frequency_rows(omega)
    taps = coefficients[:, own_poles.order :]
    # No stable poles follow N at strong lines: what they leave has to be small beside what is not known.
    scale = 1 / np.std(responses, axis=0)
    targets = ((responses - taps @ rows[:, poles.order :].T) * scale).T
    columns = scale[:, None] * rows[:, : poles.order]
    solved = np.linalg.lstsq(real_rows(columns), real_rows(targets), rcond=_RANK)[0]
    return form, np.hstack([solved.T, taps])
