"""Friction of a shaft that no sensor sees: told by inverse dynamics, and taken off the command.

The position is that of a load behind a spring (the tip of a link, the far pulley of a belt), and the friction
acts on the shaft of the motor, whose position nobody recorded. With inertias m of the motor and l of the
load, and w1 the frequency of the first mode, the shaft is ahead of the load by the spring's twist,

    shaft = y + y'' / wa^2,    wa^2 = w1^2 / (1 + l / m),

and the command is u = J y'' + d y' + (J / w1^2) y'''' + c y''' + F direction(shaft) + bias. The ratio l / m
is the one at which this regression explains most of the command, much more than it does with a shaft that
moves with the sensor. The level F comes with it.

With that friction taken off the command (`without_remote_friction`) the logs are identified as any others.
Where the level is off by a share e, the response that comes out is G (1 + e rho), rho the friction over what
is left of the command: F S_hz / S_vz, v = u - F h, h the direction and z the reference, or v where none was
recorded. `with_remote_friction` widens the ellipses by what is not known of it.

Neglected: modes beyond the first in the direction of the shaft; a level that changes with position or speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.poles import Poles
from ident.basis.posterior import ResponsePosterior
from ident.checks.plausible_modes import FEWEST_PERIODS, LIGHT
from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.friction.arm import less_friction
from ident.friction.inverse_dynamics import direction_of, presliding_of, smoothed
from ident.friction.posterior import of_force
from ident.response_coefficients import coefficients_of

# Ratios of load to motor inertia that are tried: from a load that hardly shows to a motor that
# hardly does, 20 % apart.
_RATIOS = np.geomspace(0.05, 10.0, 30)
# Ratios that are tried within one step of the best of them: 3 % apart, which moves a level by less.
_POINTS_NEAR = 15
# Dead times of the command that are tried, samples. Chosen: a controller, a bus and a drive.
_MOST_DELAY = 6
# Rows in a period of the first mode that the inverse dynamics see. Chosen: a direction turns within one.
_ROWS_IN_PERIOD = 24
# Low-pass of the inverse dynamics, in frequencies of the first mode: the ratio is told by what the mode does
# to the direction, the level below and above it.
_BANDS = (0.67, 1.0, 1.3)
# Exponent of the edge of the low-pass, as in `inverse_dynamics`.
_STEEPNESS = 8
# Low-pass of the twist, in frequencies of the first mode: above it its second derivative is noise.
_TWIST_BAND = 4.0
# Derivatives of the position in the regression.
_DERIVATIVES = (1, 2, 3, 4)
# Part of a record (one in so many) at either end that the regression leaves out: the filters ring there.
_ENDS = 20
# What a deflection before slipping is taken as, in those expected: noise moves the direction less then.
_COARSE = 10.0
# Least uncertainty of the level, a share of it, one standard deviation: elastic friction, and a law that is
# not exactly level. Chosen: levels of machines with known truth were off by 1 to 7 %, where nothing stuck.
_LEAST_STD = 0.04
# Part of what the regression leaves that may be along the direction, one standard deviation: where a shaft
# sticks for long its direction is not told, and levels come out too low. Chosen: of a machine that stuck for
# much of its log the level was off by a sixth, and as much of the friction was left.
_ALONG = 0.8
# Share of the friction that may have another phase than its direction, one standard deviation. Chosen, as
# that of an observed friction (`posterior`).
_SHAPE = 0.05
# Linear forces that a part of the friction may look like: stiffness, damping, inertia.
_FORCES = 3
# Largest uncertainty of the level, a share of it: it may be no friction at all.
_MOST_STD = 0.5
# What a shaft ahead of the sensor leaves of the command, over what one beside it leaves, at most. Chosen: of
# machines with the friction at the sensor it was .98 and more, of others .3 and .5.
_BETTER = 0.84
# Squared coherence of the instrument with what is left of the command from which on a share counts. Chosen:
# of half of the power.
_COHERENT = 0.5
# Width over which spectra are smoothed, lines on either side as a part of their number. Chosen: a tenth of an
# octave, as a mode is wide.
_SMOOTHED = 0.06
# Lines on either side at least: spectra of a window have three.
_LINES = 2
# Frequencies at which a share is told. Chosen: closer than it is smoothed.
_N_SHARES = 200
# Share of the largest gain below which a gain counts as zero: rounding of doubles (`command_timing`).
_SMALLEST_GAIN = 1e-14
# Points of the grid of frequencies on which the directions are fitted. Chosen: over five decades a hundred in
# each.
_POINTS = 500
# How far below the lowest frequency of a share that grid begins, as a factor. Chosen: a record tells nothing
# there.
_BELOW = 2
# Share of the largest relative change by friction below which changes count less than relative ones: they
# widen little there.
_MINOR = 0.03
# Taps stand no closer than two points of the grid.
_POINTS_PER_TAP = 2


@dataclass(frozen=True, eq=False)
class RemoteFriction:
    """Friction of a shaft by the inverse dynamics of a load, and the share of the command that it takes.

    Attributes
    ----------
    level, level_std : float
        Of the friction, units of the input.
    ratio : float
        Inertia of the load over that of the motor.
    first_Hz : float
        Frequency of the first mode.
    presliding : float
        Deflection over which a direction turns, units of the position.
    omega_rad_s : ndarray, shape (F,)
        Frequencies, increasing.
    share : ndarray of complex, shape (F,)
        rho there.
    like_linear : tuple of float
        Units of the input per unit of the position, of its first and of its second derivative: of a linear
        force whose rms is the friction's.
    delay_samples : int
        Dead time of the command, which does not delay the friction.
    is_told : bool
        The logs tell that the shaft is ahead of the sensor. Otherwise the level may be none, or twice as
        much.
    """

    level: float
    level_std: float
    ratio: float
    first_Hz: float
    presliding: float
    omega_rad_s: RealArray
    share: ComplexArray
    like_linear: tuple[float, ...]
    delay_samples: int = 0
    is_told: bool = True


def remote_friction(records: Sequence[Record], model: GobfModel) -> RemoteFriction:
    """Friction that logs of a loop have although no arm with friction at the sensor follows them.

    Parameters
    ----------
    records : sequence of Record
        One input and one position, as recorded.
    model : GobfModel
        Whose first light mode is that of the machine.

    Returns
    -------
    RemoteFriction

    Raises
    ------
    ValueError
        One line: the model has no light mode, or no friction is found.
    """
    name = records[0].output_names[0]
    longest_s = max(record.n_samples for record in records) * model.dt_s
    first_Hz = _first_Hz(model, longest_s)
    if first_Hz is None:
        raise ValueError(f"no light mode lies between a shaft with friction and '{name}'")
    presliding = _COARSE * presliding_of(records)
    motions = _thinned(records, first_Hz)
    # The command acts later than it was logged: by half a sample of its hold, and by dead time.
    best_left = np.inf
    delay_samples = 0
    for tried in range(_MOST_DELAY + 1):
        delayed = [motion.later((tried + 0.5) * records[0].dt_s) for motion in motions]
        left = _level(delayed, None, presliding, _BANDS[-1])[1]
        if left < best_left:
            best_left = left
            delay_samples = tried
    motions = [motion.later((delay_samples + 0.5) * records[0].dt_s) for motion in motions]

    # The ratio by the widest band, where the mode turns the direction.
    _, left_beside = _level(motions, None, presliding, _BANDS[-1])
    ratio, left = _least(motions, _RATIOS, presliding)
    is_told = left < _BETTER * left_beside
    step = np.log(_RATIOS[1] / _RATIOS[0])
    near = ratio * np.exp(np.linspace(-step, step, _POINTS_NEAR))
    ratio, _ = _least(motions, near, presliding)
    by_band = [_level(motions, ratio, presliding, band) for band in _BANDS]
    levels = [found for found, _ in by_band]
    # Below the mode an elastic friction errs least.
    level = levels[0]
    if not level > 0:
        raise ValueError(f"inverse dynamics find no friction at a shaft behind a spring from '{name}'")
    spread = float(np.std(levels)) / level
    along_direction = _ALONG * by_band[0][1] / level
    std_share = min(float(np.hypot(np.hypot(spread, along_direction), _LEAST_STD)), _MOST_STD)
    if not is_told:
        # Little of the command, or a mode that hardly swings: the ellipses hold none and twice of it.
        std_share = _MOST_STD
    return _of_level(motions, ratio, presliding, level, std_share, delay_samples, is_told)


def _first_Hz(model: GobfModel, longest_s: float) -> float | None:
    """Frequency of the first light mode that has some periods in a record of so many seconds, Hz; None where
    there is none."""
    rates = model.poles.omega_rad_s(model.dt_s)
    is_mode = (model.poles.zeta() < LIGHT) & (rates * longest_s >= 2 * np.pi * FEWEST_PERIODS)
    light = rates[is_mode]
    if not light.size:
        return None
    return float(np.min(light)) / (2 * np.pi)


def _thinned(records: Sequence[Record], first_Hz: float) -> list[_Motion]:
    """The records with `_ROWS_IN_PERIOD` rows in a period of the first mode, or as they are."""
    every = max(1, int(1 / (_ROWS_IN_PERIOD * first_Hz * records[0].dt_s)))
    return [_Motion.of(record, every, first_Hz) for record in records]


def _least(motions: Sequence[_Motion], ratios: RealArray, presliding: float) -> tuple[float, float]:
    """Of ratios (R,) the one at which the regression leaves least of the command, and how much that is."""
    left = [_level(motions, ratio, presliding, _BANDS[-1])[1] for ratio in ratios.tolist()]
    best = int(np.argmin(left))
    return float(ratios[best]), left[best]


def _of_level(
    motions: Sequence[_Motion],
    ratio: float,
    presliding: float,
    level: float,
    std_share: float,
    delay_samples: int,
    is_told: bool,
) -> RemoteFriction:
    """Friction of a level, known to a share of it, and what it is like."""
    omega, share = _share(motions, ratio, presliding, level)
    like_linear = []
    for power in range(_FORCES):
        mean_square = np.mean([np.var(motion.derivatives[power]) for motion in motions])
        like_linear.append(level / float(np.sqrt(mean_square)))
    first_Hz = motions[0].first_Hz
    return RemoteFriction(
        level,
        std_share * level,
        ratio,
        first_Hz,
        presliding,
        omega,
        share,
        tuple(like_linear),
        delay_samples,
        is_told,
    )


def without_remote_friction(record: Record, remote: RemoteFriction) -> Record:
    """A record whose command is smaller by the friction, rows (T,) as before; its output stays.

    Parameters
    ----------
    record : Record
        One input and one position, as recorded.
    remote : RemoteFriction

    Returns
    -------
    Record
        Half a sample of the input's hold is neglected.
    """
    motion = _Motion.of(record, 1, remote.first_Hz)
    friction = remote.level * motion.direction(remote.ratio, remote.presliding)
    return less_friction(record, friction, remote.delay_samples)


@dataclass(frozen=True, eq=False)
class _Motion:
    """One thinned record: position without noise and its derivatives, command and reference, (T,) each."""

    dt_s: float
    first_Hz: float
    command: RealArray
    reference: RealArray | None
    derivatives: list[RealArray]
    twist: RealArray

    @classmethod
    def of(cls, record: Record, every: int, first_Hz: float) -> _Motion:
        """Of every so many rows; the position is smoothed before it is thinned."""
        position = smoothed(record.output[:, 0])
        n, dt_s = position.size, record.dt_s
        line = np.linspace(position[0], position[-1], n)
        spectrum = np.fft.rfft(np.concatenate([position - line, -(position - line)[::-1]]))
        f_Hz = np.fft.rfftfreq(2 * n, dt_s)
        edge = 1 / (1 + (f_Hz / (_TWIST_BAND * first_Hz)) ** _STEEPNESS)

        def derivative(order: int) -> RealArray:
            values = np.fft.irfft(spectrum * (2j * np.pi * f_Hz) ** order * edge, 2 * n)[:n]
            return np.asarray(values)

        derivatives = [derivative(order) for order in _DERIVATIVES]
        twist = derivatives[1] / (2 * np.pi * first_Hz) ** 2
        derivatives[0] = derivatives[0] + (position[-1] - position[0]) / ((n - 1) * dt_s)
        # What is thinned is all through the same low-pass, so that nothing folds back.
        mirrored = np.fft.rfft(np.concatenate([record.input[:, 0], record.input[::-1, 0]]))
        command = np.fft.irfft(mirrored * edge, 2 * n)[:n]
        reference = None
        if record.reference is not None:
            reference = record.reference[::every, 0]
        return cls(
            dt_s * every,
            first_Hz,
            command[::every],
            reference,
            [position[::every], *(signal[::every] for signal in derivatives)],
            twist[::every],
        )

    def later(self, delay_s: float) -> _Motion:
        """The same with its command later by a time, s, which need not be whole rows."""
        n = self.command.size
        f_Hz = np.fft.rfftfreq(2 * n, self.dt_s)
        mirrored = np.fft.rfft(np.concatenate([self.command, self.command[::-1]]))
        shifted = np.fft.irfft(mirrored * np.exp(-2j * np.pi * f_Hz * delay_s), 2 * n)[:n]
        return replace(self, command=np.asarray(shifted))

    def direction(self, ratio: float | None, presliding: float) -> RealArray:
        """Friction (T,) of unit level at a shaft ahead of the load; beside it where the ratio is None."""
        ahead = 0.0
        if ratio is not None:
            ahead = 1 + ratio
        return direction_of(self.derivatives[0] + ahead * self.twist, presliding)

    def low(self, signals: RealArray, band: float) -> RealArray:
        """Signals (T, C) through the low-pass of the inverse dynamics, without phase, thinned at the ends."""
        n = len(signals)
        f_Hz = np.fft.rfftfreq(2 * n, self.dt_s)
        edge = 1 / (1 + (f_Hz / (band * self.first_Hz)) ** _STEEPNESS)
        values = np.fft.rfft(np.vstack([signals, signals[::-1]]), axis=0) * edge[:, None]
        filtered = np.fft.irfft(values, 2 * n, axis=0)[:n]
        ends = n // _ENDS
        return np.asarray(filtered[ends : n - ends])


def _level(
    motions: Sequence[_Motion], ratio: float | None, presliding: float, band: float
) -> tuple[float, float]:
    """Level of the friction and rms of what the regression leaves of the command, both in its units."""
    blocks = []
    for motion in motions:
        signals = [motion.direction(ratio, presliding), *motion.derivatives[1:], motion.command]
        filtered = motion.low(np.column_stack(signals), band)
        blocks.append(np.insert(filtered, 1, 1.0, axis=1))
    rows = np.vstack(blocks)
    size = np.linalg.norm(rows[:, :-1], axis=0)
    size[size == 0] = 1.0
    solution, *_ = np.linalg.lstsq(rows[:, :-1] / size, rows[:, -1], rcond=None)
    residual = rows[:, -1] - rows[:, :-1] / size @ solution
    return float(solution[0] / size[0]), float(np.std(residual))


def _share(
    motions: Sequence[_Motion], ratio: float, presliding: float, level: float
) -> tuple[RealArray, ComplexArray]:
    """Frequencies (F,), rad/s, and friction of a level over what it leaves of the command, (F,)."""
    dt_s = motions[0].dt_s
    n_fft = max(motion.command.size for motion in motions)
    cross = np.zeros((4, n_fft // 2 + 1), np.complex128)
    for motion in motions:
        window = np.hanning(motion.command.size)
        friction = level * motion.direction(ratio, presliding)
        net = motion.command - friction
        instrument = net if motion.reference is None else motion.reference
        h, v, z = (
            np.fft.rfft(window * (signal - signal.mean()), n_fft) for signal in (friction, net, instrument)
        )
        cross += [h * z.conj(), v * z.conj(), np.abs(v) ** 2, np.abs(z) ** 2]
    omega = 2 * np.pi * np.fft.rfftfreq(n_fft, dt_s)
    grid = np.geomspace(omega[_LINES + 1], 0.5 * omega[-1], _N_SHARES)
    centre = np.searchsorted(omega, grid)
    half = np.maximum(_LINES, np.round(_SMOOTHED * centre)).astype(int)
    sums = np.hstack([np.zeros((4, 1)), np.cumsum(cross, axis=1)])
    low = np.maximum(centre - half, 1)
    high = np.minimum(centre + half + 1, omega.size)
    hz, vz, vv, zz = sums[:, high] - sums[:, low]
    coherent = np.abs(vz) ** 2 > _COHERENT * np.abs(vv) * np.abs(zz)
    if not coherent.any():
        return grid, np.zeros(grid.size, np.complex128)
    return grid[coherent], (hz / vz)[coherent]


def with_remote_friction(
    posterior: ResponsePosterior, remote: RemoteFriction, poles: Poles, longest_s: float
) -> tuple[ResponsePosterior, ResponsePosterior]:
    """Posterior that holds what is not known of a friction that was taken off the command.

    Parameters
    ----------
    posterior : ResponsePosterior
        Of records `without_remote_friction`.
    remote : RemoteFriction
    poles : Poles
        Of the arm, which the posterior has twice.
    longest_s : float
        Length of the longest record, s.

    Returns
    -------
    tuple of ResponsePosterior, twice
        With further directions of its covariance: what the level may be off, and a share of the friction that
        is like a stiffness (of an arm that does not integrate), a damping or an inertia; all that is not
        known adds to the force of the arm (`of_force`), first bent and then straight. Above and below the
        frequencies of `remote` rho is that of the nearest one. The posterior itself, twice, where it has
        unstable poles or a mean of zero.
    """
    if posterior.unstable.order or not np.any(posterior.mean):
        return posterior, posterior
    omega, share = _on_grid(posterior, remote)

    # One standard deviation of each direction, relative to the gain.
    gain = _gain(posterior, omega)
    wanted = [remote.level_std / remote.level * share]
    for power in range(posterior.integrators, _FORCES):
        wanted.append(_SHAPE * remote.like_linear[power] * (1j * omega) ** power * gain)

    # On the poles and taps of the response, which hold G^2 s^i of a linear force.
    rows = posterior.frequency_rows(omega)
    columns = []
    for direction in wanted:
        size = np.maximum(np.abs(direction), _MINOR * np.max(np.abs(direction)))
        weight = 1 / (size * np.abs(gain))
        columns.append(coefficients_of(rows, (direction * gain)[:, None], weight))
    wider = replace(posterior, covariance_factor=np.hstack([posterior.covariance_factor, *columns]))
    bent, straight, _ = of_force(wider, poles, longest_s)
    return bent, straight


def _on_grid(posterior: ResponsePosterior, remote: RemoteFriction) -> tuple[RealArray, ComplexArray]:
    """Frequencies (F,), rad/s, on which a posterior is fitted again, and the share (F,) of friction there."""
    nyquist = np.pi / posterior.dt_s
    lowest = remote.omega_rad_s[0] / _BELOW
    n_even = _POINTS_PER_TAP * posterior.fir_length
    even = nyquist * np.arange(1, n_even + 1) / (n_even + 1)
    omega = np.union1d(np.geomspace(lowest, nyquist, _POINTS), even)
    log_omega = np.log(omega)
    known = np.log(remote.omega_rad_s)
    real = np.interp(log_omega, known, remote.share.real)
    imag = np.interp(log_omega, known, remote.share.imag)
    # Above what the logs tell friction takes less and less of the command.
    return omega, (real + 1j * imag) * np.minimum(1.0, remote.omega_rad_s[-1] / omega) ** 2


def _gain(posterior: ResponsePosterior, omega: RealArray) -> ComplexArray:
    """Response (F,) of a posterior, nowhere zero."""
    gain = posterior.centre(omega)
    size = np.maximum(np.abs(gain), _SMALLEST_GAIN * np.max(np.abs(gain)))
    return np.asarray(size * np.exp(1j * np.angle(gain)))
