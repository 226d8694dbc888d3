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

_REALISATIONS, _DRAWS = 128, 400  # of the input that are averaged; of the posterior that are spread
# The first period dies out from rest, the second is in steady state.
_PERIODS = 2
# A line of the spectrum counts as excited above this share of the largest.
_EXCITED = 1e-3
_N_GRID = 300  # frequencies: over five decades 30 in every half decade that is counted
# Of how much larger N is at the strongest line, what stays open of N at every line, in size and in phase.
_UNEVEN = 0.25
_HALF_WIDTHS = np.array([-4.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 4.0])


@dataclass(frozen=True, eq=False)
class EquivalentFriction:
    """The viscous friction that acts like the dry one, on average, at an amplitude of the input.

    friction: what it was simulated from. rms: of the input. omega_rad_s (F,): excited lines; stronger (F,):
    how much larger N is there than at a weak line. mean, by_level (M,): coefficients of N there (`_terms`),
    and their derivative by the level; factor (M, M): what the simulations leave open.
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
        """N at low frequency, in units of the input per (unit of position / s)."""
        return max(float(self.mean[0]), 0.0)

    def drawn(self, change: RealArray, omega: RealArray, rng: np.random.Generator) -> ComplexArray:
        """(K, W) values of N at omega (W,) for changes (K,) of the friction's level."""
        normals = rng.standard_normal((change.size, self.factor.shape[1]))
        uneven = rng.standard_normal((change.size, 2)) @ (1, 1j)
        values = self.mean + change[:, None] * self.by_level + normals @ self.factor.T
        # No line says how N goes on beyond the last.
        inside = np.minimum(omega, self.omega_rad_s[-1])
        smooth = values @ _terms(inside, self.omega_rad_s[-1], _corner(self.friction.arm)).T
        stronger = np.interp(omega, self.omega_rad_s, self.stronger)
        return np.asarray(smooth * (1 + stronger + ((_UNEVEN * self.stronger.max()) * uneven)[:, None]))


def equivalent_friction(
    friction: FrictionFit,
    records: Sequence[Record],
    rng: np.random.Generator,
) -> EquivalentFriction:
    """For random-phase multisines with the records' power spectrum, and the rms of them together."""
    rms = float(np.sqrt(np.mean([np.mean(record.input[:, 0] ** 2) for record in records])))
    spectrum = _power_spectrum(records)
    lines = np.flatnonzero(spectrum > _EXCITED * spectrum.max())
    omega = lines.astype(np.float64) * (np.pi / ((spectrum.size - 1) * friction.arm.dt_s))
    return EquivalentFriction(friction, rms, omega, *_simulated(friction, spectrum, lines, rms, rng))


def at_amplitude(
    behind: BehindFriction, equivalent: EquivalentFriction, rng: np.random.Generator
) -> tuple[ResponsePosterior, Poles]:
    """Posterior of the best linear approximation, and poles of a model of it."""
    friction, arm = behind.friction, behind.friction.arm
    spaced = np.geomspace(0.5 * equivalent.omega_rad_s[0], np.pi / arm.dt_s, _N_GRID)
    # Within and beside the half bandwidths of every pole pair, too: a mode that may have been missed is
    # narrower than the grid, and coefficients nobody looked at may have any size.
    poles = behind.response.poles
    near = poles.omega_rad_s(arm.dt_s)[:, None] * (1 + poles.zeta()[:, None] * _HALF_WIDTHS)
    omega = np.unique(np.concatenate([spaced, near[(near > spaced[0]) & (near < spaced[-1])]]))
    normals = rng.standard_normal((_DRAWS, behind.level_factor.size))
    coefficients, shaft = (
        part.mean + normals @ part.covariance_factor.T for part in (behind.response, behind.shaft)
    )
    change = behind.level + normals @ behind.level_factor - equivalent.friction.level
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
    """Rate [rad/s] of the slowest real pole: below it the input moves the shaft at a speed, above it not."""
    real = arm.poles.real[(arm.poles.real > 0) & (arm.poles.real < 1)]
    return float(-np.log(np.max(real)) / arm.dt_s) if real.size else np.inf


def _terms(omega: RealArray, last: float, corner: float) -> ComplexArray:
    """(F, M) what N is a sum of: powers of j omega, and a step at the corner of the shaft's speed."""
    powers = (1j * omega / last)[:, None] ** np.arange(4)  # a cubic, see above
    if not np.isfinite(corner):
        return np.asarray(powers)
    return np.column_stack([powers, 1j * omega / (1j * omega + corner)])


def more_at_a_strong_line(share: RealArray) -> RealArray:
    """How much larger N is at lines with these shares (0 to 1) of the power of the speed than at a weak one,
    relative to theirs: I1(h) / I0(h), h = share / (1 - share) / 2 (two-input describing function of the sign;
    Gelb and Vander Velde, Multiple-Input Describing Functions, 1968)."""
    half = 0.5 * share / np.maximum(1 - share, 1e-9)
    return np.asarray(ive(1, half) / ive(0, half))


def damped_poles(model: GobfModel, damping: float) -> Poles:
    """Poles of the model of a shaft's position with more viscous friction at the shaft (its input's units per
    speed), in continuous time behind the hold."""
    real = np.maximum(model.poles.real, FASTEST_POLE)  # a pole at zero has no rate
    arm = replace(model, poles=Poles(real, model.poles.pairs), input_delay_samples=0).to_control()
    n, dt_s = arm.nstates, model.dt_s
    rates = np.real(logm(np.block([[arm.A, arm.B], [np.zeros((1, n)), np.ones((1, 1))]]))) / dt_s
    a, b = rates[:n, :n], rates[:n, n:]
    poles = np.linalg.eigvals(expm((a - damping * b @ arm.C @ a) * dt_s))
    # The integrators stay: friction that grows with speed holds no position.
    poles = poles[np.argsort(np.abs(poles - 1))][model.integrators :]
    plain = np.abs(poles.imag) < 1e-9
    return Poles(np.sort(poles[plain].real), poles[poles.imag >= 1e-9].astype(np.complex128))


def _simulated(
    friction: FrictionFit,
    spectrum: RealArray,
    lines: npt.NDArray[np.intp],
    rms: float,
    rng: np.random.Generator,
) -> tuple[RealArray, RealArray, RealArray, RealArray]:
    """How much larger N is at every line than at a weak one (F,), coefficients (M,) of N at such a one, their
    derivative (M,) by the level, factor (M, M) of their covariance."""
    period = 2 * (spectrum.size - 1)
    arm, structure = friction.arm, friction.arm.structure
    omega = lines.astype(np.float64) * (2 * np.pi / (period * arm.dt_s))
    z = np.exp(1j * omega * arm.dt_s)
    delayed = z ** -float(structure.input_delay_samples)
    front = front_response(omega, arm.dt_s, structure.integrators, 0)
    speed = 1j * omega * front * (basis_response(arm.poles.doubled(), z) @ friction.coefficients)
    terms = _terms(omega, omega[-1], _corner(arm))
    phases = np.exp(2j * np.pi * rng.random((_REALISATIONS, spectrum.size)))
    inputs = [np.fft.irfft(spectrum * one, period) for one in phases]
    inputs = [np.tile(rms * u / np.sqrt(np.mean(u**2)), _PERIODS) for u in inputs]

    def simulated(level: float) -> ComplexArray:
        """(R, F) friction over input, line by line in steady state."""
        ratios = np.empty((_REALISATIONS, lines.size), dtype=np.complex128)
        for row, u in zip(ratios, inputs, strict=True):
            force = arm.run(friction.coefficients, u, replace(friction.law, level=level))[1]
            row[:] = np.fft.rfft(force[-period:])[lines] / np.fft.rfft(u[-period:])[lines]
        return ratios

    ratios = simulated(friction.level)
    power = np.abs(speed * (delayed - ratios.mean(axis=0)) * spectrum[lines]) ** 2
    stronger = more_at_a_strong_line(power / power.sum())
    terms *= (1 + stronger)[:, None]

    def solved(ratios: ComplexArray) -> tuple[RealArray, RealArray]:
        """N (M,) from H = N j omega G (z^-d - H), whose rest is the relative error of the BLA; and how far
        each realisation (R, M) would move it."""
        mean = ratios.mean(axis=0)
        inverse = np.linalg.pinv(real_rows((speed * (delayed - mean))[:, None] * terms))
        n = inverse @ real_rows(mean)
        rest = (ratios - mean) * (1 + speed * (terms @ n))
        return n, np.hstack([rest.real, rest.imag]) @ inverse.T

    n, moves = solved(ratios)
    # A level that is not told from none has its uncertainty for a step, and cannot be negative.
    step = max(CHANGE_OF_LOG * friction.level, 0.5 * friction.level_std)
    ends = friction.level + step, max(friction.level - step, 0.0)
    above, below = (solved(simulated(end))[0] for end in ends)
    left_open = np.asarray(np.linalg.qr((moves - moves.mean(axis=0)) / _REALISATIONS, mode="r")).T
    return stronger, n, (above - below) / (ends[0] - ends[1]), left_open


def _power_spectrum(records: Sequence[Record]) -> RealArray:
    """(F,) amplitudes of the lines of a period, or of a whole record where its input does not repeat; of the
    longest one (of an even number of samples), all records weighed alike."""
    inputs = [record.input[:, 0] for record in records]
    inputs = [u if (period := period_of(u)) is None else u[-period:] for u in inputs]
    longest = max(u.size for u in inputs) // 2 * 2
    grid, power = np.linspace(0, 1, longest // 2 + 1), np.zeros(longest // 2 + 1)
    for u in inputs:
        own = np.abs(np.fft.rfft(u)) ** 2
        power += np.interp(grid, np.linspace(0, 1, own.size), own / own.sum())
    power[0] = power[-1] = 0.0
    return np.sqrt(power)


def _on_poles(
    response: ResponsePosterior,
    damped: Poles,
    coefficients: RealArray,
    responses: ComplexArray,
    omega: RealArray,
) -> tuple[ResponsePosterior, RealArray]:
    """Responses (K, F) as coefficients (K, P), and the form they stand in: on the damped poles, twice since N
    depends on frequency, and those of the arm as often as they stand there; taps are those of the draws."""
    own = response.poles
    parts = (damped, damped, own)
    poles = Poles(
        np.concatenate([part.real for part in parts]), np.concatenate([part.pairs for part in parts])
    )
    size = poles.order + response.fir_length
    form = replace(response, poles=poles, mean=np.zeros(size), covariance_factor=np.zeros((size, 1)))
    rows, taps = form.frequency_rows(omega), coefficients[:, own.order :]
    # No stable poles follow N at strong lines: what they leave has to be small beside what is not known.
    scale = 1 / np.std(responses, axis=0)
    targets = ((responses - taps @ rows[:, poles.order :].T) * scale).T
    columns = scale[:, None] * rows[:, : poles.order]
    solved = np.linalg.lstsq(real_rows(columns), real_rows(targets), rcond=1e-10)[0]
    return form, np.hstack([solved.T, taps])
